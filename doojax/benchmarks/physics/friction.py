"""Ropes that slide over the floor: how strong friction is and which way it points."""

from collections.abc import Iterator
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from doojax.benchmarks.physics.cases import (
    GRAVITY,
    Case,
    Finding,
    Settings,
    engine_of,
    points_of,
    record,
    state_of,
)
from doojax.benchmarks.physics.closed_forms import stopping_distance
from doojax.benchmarks.physics.stepping import Stepper, mean_force
from doojax.simulation.rope import RopeKind, RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Scene
from doojax.tasks.starts import straight_qpos

LINKS, RADIUS = 25, 0.01
FRICTIONS = (0.1, 0.5)
PUSHED = 15.0  # degrees from the rope
SPEED = 0.1  # m/s of the hand that drags
KINDS: dict[str, tuple[RopeKind, ...]] = {
    "rope_dragging": ("planar_chain",),
    "dual_gripper": ("capsule_chain",),
    "default": ("planar_chain", "capsule_chain"),
}
DIRECTIONS = 12


def friction(settings: Settings, engine: str, links: int = LINKS) -> Iterator[Finding]:
    """Drag over mu m g, by a hand's force (C only) and by how far a pushed rope slides; its direction."""
    for kind in KINDS[settings.task]:
        for mu in FRICTIONS:
            case = Case(engine, settings, {"rope": kind, "friction": mu})
            scene = lying(settings, kind, links, mu)
            if engine == "mujoco":
                weight = GRAVITY * scene.rope_part.parameters.mass
                yield case.found("drag_over_weight", dragged(scene) / (mu * weight), 1, "")
            speed = 8 * mu  # m/s: it stops after 0.8 s
            angles = np.radians(np.append(np.linspace(0, 360, DIRECTIONS, endpoint=False), PUSHED))
            slid = pushed(scene, engine, speed, angles, 1.8)
            length = np.linalg.norm(slid, axis=-1) / stopping_distance(speed, mu, GRAVITY)
            turn = np.degrees(np.arctan2(slid[:, 1], slid[:, 0]) - angles)
            turn = (turn + 180) % 360 - 180
            yield case.found("slide_over_coulomb", length[0], 1, "")
            yield case.found("slide_over_coulomb_longest", length.max(), 1, "")
            yield case.found("slide_over_coulomb_shortest", length.min(), 1, "")
            yield case.found("slide_direction", PUSHED + turn[-1], PUSHED, "degrees")
            worst = turn[np.argmax(np.abs(turn))]
            yield case.found("slide_turned_most", worst, 0, "degrees", scale=PUSHED)


def lying(settings: Settings, kind: RopeKind, links: int, mu: float) -> Scene:
    """A rope of 0.8 m and 0.2 kg on the floor."""
    rope = RopeParameters(0.8, RADIUS, 0.2, 1e-3, twisting_stiffness=1e-3, bending_damping=1e-3, friction=mu)
    if kind == "planar_chain":
        rope = replace(rope, twisting_stiffness=0.0)
    hand = Gripper(links - 1, 1, RADIUS / 2, max_force=50.0, max_speed=1.0)
    scene = Scene("floor", RopeModel(kind, links), rope, (hand,), gravity=GRAVITY)
    return settings.of(scene, 0.1)


def dragged(scene: Scene) -> float:
    """The force (N) with which a hand drags a rope along itself, the mean over the third second."""
    stepper = Stepper(scene, straight_qpos(scene, scene.rope_part.parameters.radius))
    along = np.eye(stepper.home.shape[1])[0]
    samples = stepper.steps(3.0, lambda time: stepper.home + SPEED * time * along)
    return mean_force(samples, 2.0, 0, 0)


def pushed(
    scene: Scene, engine: str, speed: float, angles: Float[np.ndarray, "B"], seconds: float
) -> Float[np.ndarray, "B 2"]:
    """How far (m) ropes slide whose links all start with ``speed`` (m/s) at ``angles`` (rad) to the rope."""
    qpos = np.tile(straight_qpos(scene, scene.rope_part.parameters.radius), (len(angles), 1))
    states = state_of(scene, qpos, holding=False)
    push = speed * np.stack([np.cos(angles), np.sin(angles)], -1)
    states = eqx.tree_at(lambda s: s.qvel, states, states.qvel.at[:, :2].set(push))
    passed = list(record(engine_of(scene, engine), states, round(seconds / scene.control_period)))
    points = points_of(scene, [passed[0], passed[-1]])
    return (points[1] - points[0]).mean(1)[:, :2]
