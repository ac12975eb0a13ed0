"""What a solver that stops too early gets wrong: energy, friction, holds; and ropes that no solver saves."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.simulation.build import build_model
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.rope import RopeModel, RopeParameters, first_mode_error
from doojax.simulation.scenes import Gripper, Scene, SolverSettings
from doojax.tasks.dual_gripper import default_scene
from doojax.tasks.starts import resting
from tests.simulation.scenes import no_start, planar_scene, straight_states

STIFF_HAND = Gripper(
    link=0, end=-1, radius=0.01, max_force=5e4, max_speed=1.0, inertia=1e3, stiffness=2.5e6, hold="rigid"
)


def chain(links: int, rope: RopeParameters, *grippers: Gripper, **changes) -> Scene:
    settings = {"floor": False, "timestep": 0.002, "substeps": 50} | changes
    return Scene("chain", RopeModel("capsule_chain", links), rope, grippers, **settings)


def swing_energy(scene: Scene, degrees: float, seconds: float) -> np.ndarray:
    """Energy above rest, relative to its first value, of a straight rope let go at an angle."""
    model = build_model(scene)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data, angle = mujoco.MjData(model), np.radians(degrees)
    pitch, middle = scene.rope.length / scene.rope_model.links, scene.rope_model.links // 2
    along = np.array([np.sin(angle), 0, -np.cos(angle)])
    turn = (np.pi / 2 - angle) / 2
    data.qpos[:7] = [*(along * pitch * (middle + 0.5)), np.cos(turn), 0, np.sin(turn), 0]
    data.qpos[-3:] = data.ctrl[:] = 0
    energies = []
    for _ in range(round(seconds / scene.timestep)):
        mujoco.mj_step(model, data)
        energies.append(data.energy.sum())
    rest = -scene.rope.mass * scene.gravity * scene.rope.length / 2
    return (np.array(energies) - rest) / (energies[0] - rest)


def test_a_lightly_damped_swing_loses_energy_with_the_tasks_solver():
    task = default_scene()
    scene = replace(
        chain(25, replace(task.rope, bending_damping=1e-5), replace(STIFF_HAND, hold="point")),
        timestep=task.timestep,
        solver=task.solver,
    )
    energy = swing_energy(scene, degrees=5, seconds=6)
    assert energy.max() < 1.005
    assert 0.5 < energy[-1] < 0.99


def test_an_undamped_rope_is_refused_but_keeps_its_energy_with_rk4():
    rope = RopeParameters(0.8, 0.01, 0.2, bending_stiffness=0.0)
    scene = chain(10, rope, replace(STIFF_HAND, hold="point"), timestep=0.006)
    with pytest.raises(ValueError, match=r"bending_damping is 0 N m\^2 s, expected at least 2\.7e-05 for 10"):
        build_model(scene)
    energy = swing_energy(replace(scene, integrator="rk4"), degrees=60, seconds=4)
    assert np.abs(energy - 1).max() < 0.02


@pytest.mark.parametrize(
    ("kind", "degrees"),
    [("capsule_chain", 0), ("point_masses", 0), ("point_masses", 15), ("point_masses", 40)],
)
def test_a_rope_that_slides_on_contacts_stops_as_coulomb_says(kind, degrees):
    """With the default solver, 25 links, each in contact by itself; a chain along itself, lest it rolls."""
    bends = (1e-3, 1e-3, 1e-3) if kind == "capsule_chain" else (0.0, 0.0, 0.0)
    rope = RopeParameters(0.8, 0.01, 0.2, *bends, friction=0.1)
    hand = replace(STIFF_HAND, end=0, hold="point")
    scene = Scene("slide", RopeModel(kind, 25), rope, (hand,), timestep=0.004, substeps=250)
    push = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
    qvel, moved = np.zeros((1, scene.nv)), 3 if kind == "capsule_chain" else 3 * 25
    qvel[0, :moved] = np.resize(push, moved)
    reference = np.array(build_model(scene).qpos0)[None]
    states = resting(scene, reference)
    states = replace(states, qvel=jnp.asarray(qvel), holding=jnp.zeros_like(states.holding))
    _, seen = MujocoSimulator(scene, start=no_start).rollout(states, jnp.zeros((1, 2, 1, 3)))
    slid = (seen.states.points[0, -1] - seen.states.points[0, 0]).mean(0)
    assert float(jnp.linalg.norm(slid[:2])) == pytest.approx(1 / (2 * 0.1 * 9.81), rel=0.03)
    assert float(jnp.degrees(jnp.arctan2(slid[1], slid[0]))) == pytest.approx(degrees, abs=1.0)


@pytest.mark.parametrize("degrees", [7, 15, 30, 75])
def test_a_planar_rope_ends_within_six_degrees_of_where_it_is_pushed(degrees):
    scene = planar_scene()
    states = straight_states(scene, 1)
    push = 0.8 * jnp.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    states = eqx.tree_at(
        lambda s: (s.qvel, s.holding),
        states,
        (states.qvel.at[:, :2].set(push), jnp.zeros_like(states.holding)),
    )
    _, seen = MujocoSimulator(scene, start=no_start).rollout(states, jnp.zeros((1, 2, 1, 3)))
    slid = (seen.states.points[0, -1] - seen.states.points[0, 0]).mean(0)
    assert float(jnp.degrees(jnp.arctan2(slid[1], slid[0]))) == pytest.approx(degrees, abs=6.0)
    assert float(jnp.linalg.norm(slid)) == pytest.approx(0.8**2 / (2 * 0.1 * 9.81), rel=0.06)


@pytest.mark.parametrize("stiffness", [1e-3, 1.0])
def test_a_rope_falls_as_a_stone_does_however_stiff_it_is(stiffness):
    rope = RopeParameters(1.0, 0.01, 0.2, stiffness, stiffness, bending_damping=0.2 * stiffness)
    scene = chain(10, rope, STIFF_HAND, timestep=0.004, substeps=100)
    states = straight_states(scene, 1, height=5.0)
    states = eqx.tree_at(lambda s: s.holding, states, jnp.zeros_like(states.holding))
    _, seen = MujocoSimulator(scene, start=no_start).rollout(states, jnp.zeros((1, 1, 1, 3)))
    fallen = (seen.states.points[0, 0] - seen.states.points[0, 1])[:, 2]
    np.testing.assert_allclose(fallen, 9.81 * 0.4 * 0.404 / 2, rtol=1e-3)  # Euler: t (t + dt) / 2


def first_frequency(scene: Scene) -> float:
    """Hz, of small vibrations of a clamped rope, from when its tip comes by its height at rest."""
    model = build_model(replace(scene, gravity=0.0))
    data = mujoco.MjData(model)
    data.qpos[-3:] = data.ctrl[:] = np.asarray(straight_states(scene, 1, 0.0).qpos)[0, -3:]
    tip = model.body(f"rope{scene.rope_model.links - 1}").id
    # the static shape under a tip load is nearly the first mode
    load = 1e-3 * scene.rope.bending_stiffness / scene.rope.length**2
    for step in range(4000):
        data.xfrc_applied[tip, 2] = load * min(step / 3000, 1.0)
        data.qvel[:] *= 0.99
        mujoco.mj_step(model, data)
    data.xfrc_applied[tip, 2] = 0.0
    heights = []
    for _ in range(2000):
        mujoco.mj_step(model, data)
        heights.append(data.xpos[tip, 2])
    signal = np.array(heights)
    ups = np.flatnonzero((signal[:-1] < 0) & (signal[1:] >= 0))
    fractions = ups - signal[ups] / (signal[ups + 1] - signal[ups])
    return float((len(ups) - 1) / ((fractions[-1] - fractions[0]) * scene.timestep))


@pytest.mark.parametrize("stiffness", [1.0, 10.0])
def test_a_clamped_rope_vibrates_as_euler_and_bernoulli_say(stiffness):
    rope = RopeParameters(0.5, 0.005, 0.05, stiffness, stiffness, bending_damping=2e-5 * stiffness)
    scene = chain(20, rope, STIFF_HAND, timestep=0.001)
    assert first_mode_error(rope, 0.001) < 0.005
    exact = 1.8751**2 * np.sqrt(stiffness * 0.5 / 0.05 / 0.5**4) / (2 * np.pi)
    assert first_frequency(scene) == pytest.approx(exact, rel=0.03)


def test_a_rope_too_stiff_for_its_time_step_is_refused_with_one_that_will_do():
    rope = RopeParameters(0.5, 0.005, 0.05, 10.0, bending_damping=1e-4)
    scene = chain(10, rope, STIFF_HAND, timestep=0.004)
    with pytest.raises(
        ValueError, match=r"10 N m\^2 is too much for a timestep of 0.004 s.*off by 6%"
    ) as said:
        build_model(scene)
    enough = float(str(said.value).rsplit("at most ", 1)[1].split()[0])
    assert first_mode_error(rope, enough) < 0.031
    build_model(replace(scene, timestep=0.99 * enough))


@pytest.mark.parametrize("links", [10, 20, 40])
def test_a_rope_clamped_by_its_end_twists_and_bends_as_the_continuum(links):
    """From the clamp to the middle of the last link, on which a torque acts."""
    rope = RopeParameters(0.5, 0.005, 0.05, 1e-2, 1e-2, bending_damping=3e-3)
    scene = replace(chain(links, rope, STIFF_HAND, timestep=0.004), gravity=0.0)
    model = build_model(scene)
    data = mujoco.MjData(model)
    data.ctrl[:] = data.qpos[-3:] = np.asarray(straight_states(scene, 1, rope.radius).qpos)[0, -3:]
    tip, free = model.body(f"rope{links - 1}").id, 0.5 * (1 - 0.5 / links)
    for axis in (0, 1):
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = data.qpos[-3:] = np.asarray(straight_states(scene, 1, rope.radius).qpos)[0, -3:]
        data.xfrc_applied[tip, 3 + axis] = 2e-3
        for _ in range(2500):
            mujoco.mj_step(model, data)
        frame = data.xmat[tip].reshape(3, 3)
        angle = np.arctan2(frame[2, 1], frame[1, 1]) if axis == 0 else np.arctan2(-frame[2, 0], frame[0, 0])
        assert angle == pytest.approx(2e-3 * free / 1e-2, rel=0.01)


def test_default_settings_end_where_a_converged_solver_does():
    """A rope taut over an edge of the floor's, dragged: 0.5 s later all links are within a tenth of a mm."""
    rope = RopeParameters(0.5, 0.01, 0.1, 1e-3, 1e-3, bending_damping=1e-3, friction=0.3)
    hand = Gripper(link=0, end=-1, radius=0.01, max_force=20.0, max_speed=0.2)
    ends = []
    for solver in (SolverSettings(), SolverSettings(iterations=200, tolerance=1e-14)):
        scene = chain(12, rope, hand, floor=True, timestep=0.004, substeps=125, solver=solver)
        states = straight_states(scene, 1, height=0.05)
        action = jnp.array([[[[0.02, 0.05, -0.03]]]])
        _, seen = MujocoSimulator(scene, start=no_start).rollout(states, action)
        ends.append(np.asarray(seen.states.points[0, -1]))
    assert np.abs(ends[0] - ends[1]).max() < 1e-4
