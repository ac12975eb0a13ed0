"""Hands grasp, let go and grasp elsewhere: where they were told, by data alone, the same on C and MJX."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.simulation.build import build_model
from doojax.simulation.engines.mujoco import MujocoSimulator, write_state
from doojax.simulation.grasps import check_grasp, grasp_places, graspable, grasped, released, rope_point
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Scene, SolverSettings
from doojax.simulation.state import at_rest
from doojax.tasks.starts import straight_qpos
from tests.simulation.scenes import no_start, planar_scene

HAND = Gripper(link=None, end=0, radius=0.02, max_force=40.0, max_speed=0.2)
LENGTH, LINKS, HEIGHT = 0.5, 5, 1.0
SCENE = Scene(
    name="grasping",
    rope_model=RopeModel("capsule_chain", LINKS),
    rope=RopeParameters(LENGTH, 0.01, 0.1, bending_stiffness=2e-3, bending_damping=2e-3),
    grippers=(HAND, HAND),
    floor=False,
    timestep=0.004,
    substeps=125,
    viscosity=1.0,
    solver=SolverSettings(cone="pyramidal"),
    grasps=True,
)
SIMULATOR = MujocoSimulator(SCENE, start=no_start)
STILL = jnp.zeros((1, 2, 3))


def held(first: float, second: float | None):
    """A straight level rope, hands at these places along it, which they grasp."""
    qpos = np.array(straight_qpos(SCENE, HEIGHT), np.float32)
    for hand, place in enumerate((first, 0.5 if second is None else second)):
        qpos[SCENE.layout.driven[hand]] = [(place - 0.5) * LENGTH, 0, HEIGHT]
    state = graspable(SCENE, at_rest(SCENE, jnp.asarray(qpos), jnp.zeros((0, 3)), jnp.zeros((0, 4))))
    assert not state.holding.any()
    state = grasped(SCENE, state, 0, first)
    return state if second is None else grasped(SCENE, state, 1, second)


def after(state, seconds: float, actions=STILL):
    batch = jax.tree.map(lambda leaf: leaf[None], state)
    actions = jnp.tile(actions, (int(seconds / 0.5), 1, 1))[None]
    last, trajectory = SIMULATOR.rollout(batch, actions)
    assert not trajectory.faults.any()
    return jax.tree.map(lambda leaf: leaf[0], last)


PLACES = np.linspace(0, 1, 201)


@jax.jit
def gaps(seen):
    """From each hand to places all along the rope."""
    points = jax.vmap(lambda place: rope_point(SCENE, seen, place))(PLACES)
    return jnp.linalg.norm(points - seen.hands[:, None], axis=-1)


def gap(state, hand: int, place: float) -> float:
    index = int(np.argmin(np.abs(PLACES - place)))
    assert abs(PLACES[index] - place) < 1e-6
    return float(gaps(SIMULATOR.observation(state))[hand, index])


def test_a_rope_is_held_where_it_was_grasped():
    for place in (0.0, 0.27, 1.0):
        state = after(held(place, None), 6)
        assert gap(state, 0, place) < 2e-3
        nearest = PLACES[np.argmin(gaps(SIMULATOR.observation(state))[0])]
        assert abs(nearest - place) * LENGTH < 5e-3
        assert grasp_places(SCENE, state)[0] == pytest.approx(place, abs=1e-6)
        assert np.isnan(grasp_places(SCENE, state)[1])


def test_after_release_nothing_of_the_hold_remains():
    state = after(held(0.3, 0.8), 2)
    assert gap(state, 0, 0.3) < 2e-3 and gap(state, 1, 0.8) < 2e-3
    free = released(SCENE, released(SCENE, state, 0), 1)
    assert np.isnan(grasp_places(SCENE, free)).all()
    begin = SIMULATOR.observation(free).state
    last = after(free, 0.5)
    end = SIMULATOR.observation(last).state
    assert float((begin.points - end.points).mean(0)[2]) > 0.15  # it falls through a viscous medium
    assert float(jnp.abs(end.grippers - begin.grippers).max()) < 1e-2  # hands stay, without the load
    # as if there were no grasps at all
    bare = replace(SCENE, grasps=False)
    never = at_rest(bare, free.qpos, jnp.zeros((0, 3)), jnp.zeros((0, 4)))
    never = replace(never, qvel=free.qvel, commanded=free.commanded)
    alone, _ = MujocoSimulator(bare, start=no_start).rollout(
        jax.tree.map(lambda leaf: leaf[None], never), STILL[None]
    )
    np.testing.assert_allclose(alone.qpos[0], last.qpos, atol=1e-5)


def test_a_hand_grasps_elsewhere_while_the_other_holds():
    state = after(held(0.1, 0.7), 1)
    place = 0.45
    free = released(SCENE, state, 1)
    seen = SIMULATOR.observation(free)
    with pytest.raises(
        ValueError, match=r"hand 1 is 0\.\d+ m from the rope at 0\.45, expected at most 0\.05 m"
    ):
        check_grasp(SCENE, seen, 1, place)
    near = free
    for _ in range(8):  # the rope swings down, and the hand follows
        seen = SIMULATOR.observation(near)
        way = rope_point(SCENE, seen, place) - seen.hands[1]
        near = after(near, 0.5, jnp.zeros((1, 2, 3)).at[0, 1].set(way))
    seen = SIMULATOR.observation(near)
    check_grasp(SCENE, seen, 1, place)
    again = after(grasped(SCENE, near, 1, place), 3)
    assert gap(again, 0, 0.1) < 2e-3 and gap(again, 1, place) < 2e-3
    assert grasp_places(SCENE, again) == pytest.approx(np.array([0.1, place]), abs=1e-6)


WEIGHTLESS = replace(SCENE, gravity=0.0, viscosity=0.0)


def stepped(state, steps: int):
    """Of the rope and the hands, without weight: what MuJoCo's own forces explain, step by step.

    Change of the rope's linear momentum and the impulse of constraints on it (N s); change of the energy of
    everything and the work of constraints and controllers (J).
    """
    model = build_model(WEIGHTLESS)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(model)
    write_state(model, WEIGHTLESS.layout, state)
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    data.ctrl[:] = np.asarray(state.commanded).ravel()
    linear = WEIGHTLESS.layout.places["rope"].dofs[:3]

    def momentum():
        found = np.zeros(model.nv)
        mujoco.mj_forward(model, data)
        mujoco.mj_mulM(model, data, found, data.qvel)
        return found[linear], float(data.energy.sum())

    before, rows = momentum(), []
    for _ in range(steps):
        speed, held, driven = data.qvel.copy(), data.qfrc_constraint.copy(), data.qfrc_actuator.copy()
        mujoco.mj_step(model, data)
        after, way = momentum(), model.opt.timestep * (speed + data.qvel) / 2
        impulse = model.opt.timestep * held[linear]
        rows.append([*(after[0] - before[0]), after[1] - before[1], *impulse, (held + driven) @ way])
        before = after
    found = np.array(rows)
    end = replace(state, qpos=jnp.asarray(data.qpos, jnp.float32), qvel=jnp.asarray(data.qvel, jnp.float32))
    return found[:, :3], found[:, 4:7], found[:, 3], found[:, 7], end


def test_momentum_and_energy_change_by_what_the_hold_explains():
    state = held(0.3, None)
    away = state.qpos.at[SCENE.layout.driven[0]].add(jnp.array([0.0, 0.012, 0.016]))  # 2 cm
    state = replace(state, qpos=away, commanded=away[SCENE.layout.driven])
    assert (grasped(SCENE, state, 0, 0.3).qvel == state.qvel).all()  # a grasp itself moves nothing
    gained, impulse, energy, work, moving = stepped(state, 60)
    largest = np.abs(impulse).max()
    assert largest > 1e-3  # the hold closes the gap
    np.testing.assert_allclose(gained, impulse, atol=0.05 * largest)
    assert (energy <= work + 0.05 * np.abs(work).max()).all()

    gained, impulse, energy, _, _ = stepped(released(SCENE, moving, 0), 60)
    assert np.abs(impulse).max() == 0
    assert np.abs(gained).max() < 0.02 * largest
    assert (np.cumsum(energy) < 0.01 * np.abs(work).sum()).all()


def test_each_element_of_a_batch_has_its_own_grasp_without_a_new_compile():
    traces = []

    @jax.jit
    @jax.vmap
    def regrasped(state, hand, place):
        traces.append(1)
        return grasped(SCENE, released(SCENE, state, hand), hand, place)

    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), held(0.2, 0.9))
    for places in ([0.1, 0.5, 0.99], [1.0, 0.0, 0.3]):
        found = regrasped(states, jnp.array([0, 1, 0]), jnp.array(places))
        every = jax.vmap(lambda state: grasp_places(SCENE, state))(found)
        expected = [[places[0], 0.9], [0.2, places[1]], [places[2], 0.9]]
        assert np.asarray(every) == pytest.approx(np.array(expected), abs=1e-6)
    assert len(traces) == 1
    last, _ = SIMULATOR.rollout(found, jnp.zeros((3, 8, 2, 3)))
    for element in range(3):
        one = jax.tree.map(lambda leaf, e=element: leaf[e], last)
        for hand, place in enumerate(expected[element]):
            assert gap(one, hand, place) < 2e-3


@pytest.mark.slow
def test_mjx_does_what_c_does():
    from doojax.simulation.engines.mjx import MjxSimulator

    mjx = MjxSimulator(SCENE, start=no_start)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), held(0.1, 0.62), held(0.35, 0.9))
    ours, seen = mjx.rollout(states, jnp.zeros((2, 2, 2, 3)))
    theirs, expected = SIMULATOR.rollout(states, jnp.zeros((2, 2, 2, 3)))
    assert not seen.faults.any()
    assert float(jnp.abs(seen.states.points - expected.states.points).max()) < 1e-3
    assert float(jnp.abs(ours.qpos - theirs.qpos).max()) < 5e-3


def test_bad_grasps_are_told():
    state = held(0.5, None)
    with pytest.raises(ValueError, match=r"place is 1\.2, expected 0 to 1"):
        grasped(SCENE, state, 0, 1.2)
    with pytest.raises(ValueError, match="hand is 2, expected 0 to 1"):
        grasped(SCENE, state, 2, 0.5)
    plain = planar_scene()
    none = at_rest(plain, jnp.zeros(plain.nq), jnp.zeros((1, 3)), jnp.zeros((1, 4)))
    with pytest.raises(ValueError, match="scene 'small' has no grasps: make it with grasps=True"):
        grasped(plain, none, 0, 0.5)
    bare = at_rest(SCENE, state.qpos, jnp.zeros((0, 3)), jnp.zeros((0, 4)))
    with pytest.raises(ValueError, match="no data of grasps: make it with graspable"):
        released(SCENE, bare, 0)
    with pytest.raises(ValueError, match="'nothing' has grasps and no rope"):
        Scene("nothing", None, None, (HAND,), grasps=True)


RIGID = replace(SCENE, grasp_hold="rigid", name="rigid")


def test_a_rigid_hold_keeps_the_ropes_direction_where_a_point_lets_it_fall():
    simulator = MujocoSimulator(RIGID, start=no_start)

    def steep(scene, engine):
        """How steep the first link hangs that a hand holds by its end, and which was level: its sine."""
        qpos = np.array(straight_qpos(SCENE, HEIGHT), np.float32)
        for hand, place in enumerate((0.0, 0.5)):
            qpos[SCENE.layout.driven[hand]] = [(place - 0.5) * LENGTH, 0, HEIGHT]
        state = graspable(scene, at_rest(scene, jnp.asarray(qpos), jnp.zeros((0, 3)), jnp.zeros((0, 4))))
        turn = jnp.asarray(engine.turn_in_hand(state, 0, 0.0)) if scene.grasp_hold == "rigid" else None
        state = grasped(scene, state, 0, 0.0, turn)
        batch = jax.tree.map(lambda leaf: leaf[None], state)
        last, _ = engine.rollout(batch, jnp.zeros((1, 8, 2, 3)))
        seen = engine.observations(last)
        assert grasp_places(scene, jax.tree.map(lambda leaf: leaf[0], last))[0] == pytest.approx(0, abs=1e-6)
        along = np.asarray(seen.half_links)[0, 0]
        return abs(along[2]) / np.linalg.norm(along)

    assert steep(SCENE, SIMULATOR) > 0.9
    assert steep(RIGID, simulator) < 0.1


def test_a_turn_is_asked_for_where_holds_keep_it_and_nowhere_else():
    bare = at_rest(RIGID, jnp.asarray(straight_qpos(SCENE, HEIGHT)), jnp.zeros((0, 3)), jnp.zeros((0, 4)))
    with pytest.raises(ValueError, match="hands of scene 'rigid' hold the rope by a rigid hold: give one"):
        grasped(RIGID, graspable(RIGID, bare), 0, 0.5)
    with pytest.raises(ValueError, match="which lets it turn: expected none"):
        grasped(SCENE, graspable(SCENE, bare), 0, 0.5, jnp.array([1.0, 0, 0, 0]))
    assert len({SCENE.digest, replace(RIGID, name=SCENE.name).digest}) == 2


def test_what_one_state_holds_another_one_does_not():
    """Elements of a batch share models with those of earlier ones."""
    first, second = held(0.27, None), held(0.9, None)
    after(second, 0.5)
    once = after(first, 0.5)
    after(second, 0.5)
    np.testing.assert_array_equal(after(first, 0.5).qpos, once.qpos)
