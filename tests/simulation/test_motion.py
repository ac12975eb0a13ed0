"""Hands and the commands they are given, ropes that go through things, and what one call leaves behind."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.simulation.build import with_parameters
from doojax.simulation.engines import make_simulator
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.layout import look_every
from doojax.simulation.parts.hands import gripper_targets
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, Shape
from doojax.simulation.state import Fault, SimState
from doojax.tasks.dual_gripper import default_scene
from doojax.types import ShapeKind
from tests.simulation.scenes import no_start, planar_scene, straight_states


def placed(states: SimState, *where: tuple[float, float, float]) -> SimState:
    """The states with the scene's obstacles at these places (m), upright."""
    count = states.qpos.shape[0]
    upright = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (count, len(where), 1))
    return replace(
        states, obstacle_position=jnp.tile(jnp.array(where), (count, 1, 1)), obstacle_quaternion=upright
    )


def test_hands_that_are_sent_nowhere_do_not_sink():
    scene = replace(default_scene(), obstacles=())
    states = straight_states(scene, 1, height=1.5)
    inward = jnp.array([[[0.1, 0, 0], [-0.1, 0, 0]]])
    states, _ = MujocoSimulator(scene, no_start).rollout(states, inward[None])
    _, seen = MujocoSimulator(scene, no_start).rollout(states, jnp.zeros((1, 100, 2, 3)))
    heights = seen.states.grippers[0, :, :, 2]
    assert float(heights[0].min() - heights[-1].min()) < 1e-3
    assert float(1.5 - heights[-1].min()) < 2e-3  # 0.1 kg on a spring of 2500 N/m: 0.4 mm


def test_a_hand_that_a_cube_holds_back_turns_round_at_once():
    scene = planar_scene()
    states = placed(straight_states(scene, 1), (0.2, 0.0, 0.05))
    push, back = jnp.array([0.12, 0, 0]), jnp.array([-0.05, 0, 0])
    actions = jnp.stack([push] * 5 + [back])[None, :, None]
    _, seen = MujocoSimulator(scene, no_start).rollout(states, actions)
    x = seen.states.grippers[0, :, 0, 0]
    assert float(x[5]) == pytest.approx(0.13, abs=2e-3)  # the cube's face less the hand's radius
    assert float(x[5] - x[6]) == pytest.approx(0.05, abs=6e-3)  # 4 mm lead the force of 10 N


def test_a_command_leads_the_hand_by_no_more_than_its_force_needs():
    scene = planar_scene(substeps=4)
    hand, sent = np.array([[0.1, 0.2]]), np.array([[0.1005, 5.0]])
    targets = gripper_targets(scene, hand, sent, np.zeros((1, 2)), xp=np)
    np.testing.assert_allclose(targets, [[[0.1005, 0.204]]] * 4)  # 10 N over 2500 N/m


def test_derivatives_at_zero_action_are_those_beside_it():
    scene = planar_scene(substeps=50)
    still = jnp.zeros((1, 2))

    def summed(action):
        return gripper_targets(scene, still, still, action).sum()

    for at in (still, still + 1e-6):
        np.testing.assert_allclose(jax.grad(summed)(at), 50.0)  # the target is there after one step
        np.testing.assert_allclose(jax.jvp(summed, (at,), (still + 1,))[1], 100.0)


def plate_scene(thickness: float) -> Scene:
    """A rope above a plate, held by its middle."""
    plate = Obstacle("plate", (Shape(ShapeKind.BOX, (0.5, 0.5, thickness / 2)),))
    return Scene(
        "plate",
        RopeModel("capsule_chain", 8),
        RopeParameters(0.3, 0.01, 0.08, 1e-4, 1e-4, bending_damping=1e-4, friction=0.3),
        (Gripper(4, 0, 0.01, 5.0, 0.15),),
        (plate,),
        floor=False,
        timestep=0.006,
        substeps=50,
    )


def thrown(scene: Scene, speed: float):
    """What comes of a rope that is thrown down flat at the plate, from 5 cm, and let go; two periods."""
    states = placed(straight_states(scene, 1, height=0.05), (0.0, 0.0, 0.0))
    states = eqx.tree_at(
        lambda s: (s.qvel, s.holding),
        states,
        (states.qvel.at[:, 2].set(-speed), jnp.zeros_like(states.holding)),
    )
    return MujocoSimulator(scene, no_start).rollout(states, jnp.zeros((1, 2, 1, 3)))[1]


def test_a_rope_that_goes_through_a_plate_is_a_fault_of_the_period():
    seen = thrown(plate_scene(0.002), speed=6.0)
    assert float(seen.states.points[0, -1, :, 2].max()) < -0.1  # through it
    assert int(seen.faults[0, 0]) & int(Fault.PASSED_THROUGH)
    assert float(seen.clearance[0, 1]) < -0.009


def test_a_rope_that_comes_to_lie_on_a_plate_is_none():
    seen = thrown(plate_scene(0.02), speed=0.3)
    assert not seen.faults.any()
    assert float(jnp.abs(seen.states.points[0, -1, :, 2] - 0.02).max()) < 3e-3
    assert float(seen.clearance[0, 1:].min()) < 2e-3  # it touched within the period, or after it


def test_the_least_clearance_is_of_the_whole_period():
    """A rope dragged past a post and away again in one period."""
    scene = planar_scene(substeps=200)
    states = placed(straight_states(scene, 1), (0.3, 0.16, 0.05))
    there_and_on = jnp.array([[[[0.36, 0.0, 0.0]]]])
    fast = replace(scene, grippers=(replace(scene.grippers[0], max_speed=0.5),))
    _, seen = MujocoSimulator(fast, no_start).rollout(states, there_and_on)
    ends = seen.states.grippers[0, :, 0, :2] - jnp.array([0.3, 0.16])
    at_ends = jnp.linalg.norm(jnp.maximum(jnp.abs(ends) - 0.05, 0), axis=-1).min() - 0.02
    assert float(at_ends) > 0.12
    assert float(seen.clearance[0, 1]) == pytest.approx(0.16 - 0.05 - 0.02, abs=0.012)


def test_looks_divide_a_period():
    assert [look_every(planar_scene(substeps=n)) for n in (1, 7, 20, 150, 11, 202)] == [1, 7, 10, 10, 1, 2]


def test_another_ropes_parameters_do_not_outlive_a_call():
    scene = planar_scene()
    simulator = make_simulator(scene, no_start, "mujoco")
    states = straight_states(scene, 2)
    actions = jnp.tile(jnp.array([[[[0.05, 0.1, 0.0]]]]), (2, 1, 1, 1))
    before = simulator.rollout(states, actions)[1].states.points
    stiff = with_parameters(scene, [replace(scene.rope, bending_stiffness=0.05)] * 2)
    other = replace(states, model_fields={name: jnp.asarray(value) for name, value in stiff.items()})
    bent = simulator.rollout(other, actions)[1].states.points
    assert float(jnp.abs(bent - before).max()) > 5e-4
    assert bool(jnp.array_equal(simulator.rollout(states, actions)[1].states.points, before))
