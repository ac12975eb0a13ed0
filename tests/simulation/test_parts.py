"""Scenes of parts: what each adds, where it is found, and that only the parts know."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.geometry.motion import RigidMotion
from doojax.keys import generator
from doojax.simulation.build import build_model
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.parts.cylinders import mass
from doojax.simulation.rope import RopeModel
from doojax.simulation.scenes import Cylinder, Gripper, Scene
from doojax.simulation.state import SimState, at_rest
from doojax.tasks.starts import moved_state
from tests.simulation.scenes import no_start, planar_scene

ROOT = Path(__file__).parents[2]
HAND = Gripper(link=None, end=0, radius=0.02, max_force=20.0, max_speed=0.1)
RADIUS, FRICTION = 0.02, 0.4


def pushing_scene(count: int = 2, **changes) -> Scene:
    one = Cylinder(RADIUS, 0.04, mass(RADIUS, 0.04), FRICTION)
    settings = {
        "name": "pushed",
        "rope_model": None,
        "rope": None,
        "grippers": (HAND,),
        "timestep": 0.002,
        "substeps": 200,
        "cylinders": (one,) * count,
    }
    return Scene(**(settings | changes))


def placed(scene: Scene, hand, cylinders) -> SimState:
    qpos = np.zeros((1, scene.nq))
    qpos[0, scene.layout.driven] = hand
    qpos[0, scene.layout.places["cylinders"].qpos[:, :2]] = cylinders
    none = jnp.zeros((0, 3)), jnp.zeros((0, 4))
    return jax.vmap(lambda own: at_rest(scene, own, *none))(jnp.asarray(qpos, jnp.float32))


def rolled(scene: Scene, start: SimState, actions):
    simulator = MujocoSimulator(scene, start=no_start)
    return simulator.rollout(start, jnp.asarray(actions, jnp.float32)[None])


def test_a_row_is_pushed_as_far_as_the_hand_goes_into_it():
    """The hand touches the first cylinder after 1 cm, which touches the second after 2 more."""
    scene = pushing_scene()
    start = placed(scene, [[-0.1, 0.0]], [[-0.05, 0.0], [0.01, 0.0]])
    _, seen = rolled(scene, start, [[[0.03, 0.0, 0.0]]] * 3)
    states = seen.states
    np.testing.assert_allclose(states.hand[0, :, 0], [-0.1, -0.07, -0.04, -0.01], atol=5e-4)
    np.testing.assert_allclose(states.positions[0, :, 0, 0], [-0.05, -0.03, 0.0, 0.03], atol=1e-3)
    np.testing.assert_allclose(states.positions[0, :, 1, 0], [0.01, 0.01, 0.04, 0.07], atol=1e-3)
    assert float(jnp.abs(states.positions[0, ..., 1]).max()) < 1e-3
    np.testing.assert_allclose(states.positions[0, ..., 2], RADIUS, atol=5e-4)
    assert not seen.faults.any() and float(jnp.abs(states.velocities[0, -1]).max()) < 0.01


def test_a_cylinder_slides_to_a_stop_as_coulomb_says_whatever_its_direction():
    scene = pushing_scene(1)
    for angle in (0.0, 0.3, np.pi / 4):
        start = placed(scene, [[1.0, 1.0]], [[0.0, 0.0]])
        dofs, speed = scene.layout.places["cylinders"].dofs[0, :2], 0.5
        way = speed * np.array([np.cos(angle), np.sin(angle)])
        start = SimState(
            **(vars(start) | {"qvel": start.qvel.at[0, dofs].set(jnp.asarray(way, jnp.float32))})
        )
        _, seen = rolled(scene, start, np.zeros((1, 1, 3)))
        end = np.asarray(seen.states.positions[0, -1, 0, :2])
        expected = speed**2 / (2 * FRICTION * scene.gravity)
        np.testing.assert_allclose(np.linalg.norm(end), expected, rtol=0.05)
        np.testing.assert_allclose(np.arctan2(end[1], end[0]), angle, atol=0.01)
        np.testing.assert_allclose(seen.states.velocities[0, 0, 0, :2], way, atol=1e-6)


def test_pushing_does_not_depend_on_where():
    scene = pushing_scene()
    start = placed(scene, [[-0.06, 0.005]], [[0.0, 0.0], [0.045, 0.01]])
    actions = np.array([[[0.04, 0.0, 0.0]]] * 2)
    middle, _ = rolled(scene, start, actions[:1])
    middle = jax.tree.map(jnp.asarray, middle)
    motion = RigidMotion.of(jnp.array([0.1, -0.05, 0.0, 0.0, 0.0, 0.7]), jnp.array([0.1, 0.2, 0.0]))
    move = jax.vmap(lambda state: moved_state(scene, state, motion.about_origin, motion.quaternion))
    _, here = rolled(scene, middle, actions[1:])
    _, there = rolled(scene, move(middle), np.asarray(motion.vectors(jnp.asarray(actions[1:], jnp.float32))))
    expected = here.states.moved(motion)
    np.testing.assert_allclose(there.states.bodies()[0, 0], expected.bodies()[0, 0], atol=1e-6)
    np.testing.assert_allclose(there.states.bodies()[0, 1], expected.bodies()[0, 1], atol=1e-4)
    assert float(jnp.abs(here.states.positions[0, 1] - here.states.positions[0, 0]).max()) > 0.02


def test_addresses_are_the_model_s():
    """Wherever a part is moved, its own coordinates change, and those of no other part."""
    for scene in (planar_scene(), pushing_scene(3)):
        model, layout = build_model(scene), scene.layout
        assert (layout.nq, layout.nv) == (model.nq, model.nv) == (scene.nq, scene.nv)
        named = [model.joint(int(np.flatnonzero(model.jnt_qposadr == a)[0])).name for a in layout.driven[0]]
        assert named == ["gripper0_x", "gripper0_y"]
        qpos = jnp.asarray(generator(0, "addresses").normal(size=model.nq), jnp.float32)
        turn = scene.driver.moved(layout.places["hands"], qpos, jnp.zeros(model.nv), _turn())
        changed = np.flatnonzero(np.asarray(turn[0] != qpos))
        assert set(changed) == set(layout.driven.reshape(-1))


def _turn():
    from doojax.simulation.parts import Turn

    return Turn(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array(0.0), jnp.array([0.1, 0.2, 0.3]))


def test_scenes_of_before_keep_their_digests_and_cylinders_count_in_others():
    two, three = pushing_scene(2), pushing_scene(3)
    assert two.digest != three.digest
    assert planar_scene().digest == planar_scene(cylinders=()).digest


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rope_model": RopeModel("planar_chain", 4)}, "expected both, or None twice"),
        ({"grippers": (HAND, HAND)}, "2 hands and no rope: expected one hand that pushes"),
        ({"grippers": (Gripper(0, 1, 0.02, 1.0, 1.0),)}, "gripper 0 holds link 0, but there is no rope"),
    ],
)
def test_scenes_that_make_no_sense(changes, message):
    with pytest.raises(ValueError, match=message):
        pushing_scene(**changes)


def test_a_cylinder_without_mass():
    with pytest.raises(ValueError, match=r"a cylinder's mass is 0\.0, expected > 0"):
        Cylinder(0.02, 0.04, 0.0, 0.4)


def test_no_arithmetic_on_addresses_outside_the_parts():
    """Who counts from the end of qpos, or asks the rope how many links it has, breaks with the next part."""
    for path in sorted((ROOT / "doojax").rglob("*.py")):
        if "simulation" not in path.parts:
            found = re.findall(r"q(?:pos|vel)\[[^\]]*-\d|rope_model\.links", path.read_text())
            assert not found, f"{path} has {found}: ask Scene.layout, or Scene.links"


def test_the_engines_do_not_import_each_other():
    warp = (ROOT / "doojax/simulation/engines/warp.py").read_text()
    assert "engines.mjx" not in warp
