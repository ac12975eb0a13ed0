"""A cable that one of two arms holds for good; its end is to come to a place among boxes.

World frame: z up, the floor at 0, the robot's base at `doojax.tasks.arms.BASE`. The right tool holds a cable
of 15 links, so that 30 cm of it bend down to its end, and 70 cm on the other side. A goal is where that end
is when joints drawn around the start's are at rest there and everything is free: so every scene can be
solved, by that posture at least. The first box stands on the end's straight way there.
"""

from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.segment_sdf import segment_signed_distance
from doojax.keys import generator
from doojax.robots import (
    Robot,
    dual_arm,
    floor_distances,
    obstacle_distances,
    self_distance,
    tool_poses,
)
from doojax.simulation.grasps import graspable, grasped
from doojax.simulation.layout import Observation
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Scene, SolverSettings, obstacles_at
from doojax.simulation.state import SimState, at_rest
from doojax.tasks.arms import (
    ARMS,
    BASE,
    MARGIN,
    SUBSTEPS,
    TIMESTEP,
    box,
    joint_addresses,
    rope_ends,
)
from doojax.types import Obstacles

HELD, HAND = 0.7, 1  # along the cable; the right tool
LENGTH, RADIUS = 1.0, 0.01  # m
HALVES = ((0.12, 0.04, 0.12), (0.05, 0.12, 0.08), (0.06, 0.06, 0.06), (0.04, 0.04, 0.25))  # m, of the boxes
REGION = ((-0.4, 0.35, 0.3), (0.8, 1.0, 1.3))  # m, of their centres, but for the first
IN_THE_WAY = (0.35, 0.65)  # of the end's way, where the first is
BESIDE = 0.04  # m, that it is off the way at most, along each axis
GOAL_RADIUS = 0.05  # m, within which the end is there
OUT = {"left_shoulder_2": 0.25, "right_shoulder_2": -0.25}  # rad: at zero elbows are 5 mm from the torso
SPREAD = (0.3, 0.3, 0.8)  # rad, of the torso's joints and the arm's around the start's
FREE = 0.03  # m, that boxes and floor are away at the start, and at the posture of the goal
DRAWS = 64  # postures and boxes that are tried at once
SETTLING = 3.0  # s, in which the cable comes to hang


def scene(timestep: float = TIMESTEP, substeps: int = SUBSTEPS) -> Scene:
    """Arms, the cable and the boxes; a control period of 0.2 s."""
    return Scene(
        name="arm_reaching",
        rope_model=RopeModel("capsule_chain", 15),
        rope=RopeParameters(
            LENGTH, RADIUS, 0.36, bending_stiffness=4e-3, bending_damping=1.5e-3, friction=1.0
        ),
        grippers=(),
        obstacles=tuple(box(f"box{index}", *half) for index, half in enumerate(HALVES)),
        timestep=timestep,
        substeps=substeps,
        viscosity=1.0,
        solver=SolverSettings(cone="pyramidal", contact_time=max(2 * timestep, 0.01)),
        arms=ARMS,
        grasps=True,
    )


class Reaching(NamedTuple):
    """One scene."""

    state: SimState
    goal: Float[np.ndarray, "3"]  # of the cable's end, m


class ArmReaching:
    """Scenes on MuJoCo C, by number; making one settles the cable once."""

    def __init__(self, own: Scene | None = None):
        """Of a scene, by default `scene`."""
        self.scene = scene() if own is None else own
        from doojax.simulation.engines.mujoco import MujocoSimulator

        self.simulator = MujocoSimulator(self.scene, start=_no_start)
        self.robot = dual_arm()
        self.moving = np.array([i for i, name in enumerate(self.robot.joints) if "finger" not in name])
        names = self.scene.driver.joints  # pyright: ignore[reportAttributeAccessIssue]
        self.actuated = np.array([names.index(self.robot.joints[i]) for i in self.moving])

    def end(self, seen: Observation) -> Float[Array, "*b 3"]:
        """The cable's end, m."""
        return rope_ends(self.scene, seen)[..., -1, :]

    def reached(self, state: SimState, goal: Float[np.ndarray, "3"]) -> bool:
        """Whether the cable's end is at the goal."""
        return float(jnp.linalg.norm(self.end(self.simulator.observation(state)) - goal)) <= GOAL_RADIUS

    def obstacles(self, state: SimState) -> Obstacles:
        """In the base's frame."""
        found = obstacles_at(self.scene, state.obstacle_position, state.obstacle_quaternion)
        return eqx.tree_at(lambda o: o.centre, found, found.centre - jnp.array(BASE))

    @cached_property
    def settled(self) -> SimState:
        """The arms a little apart from the torso, the cable at rest, all boxes parked."""
        qpos, joints = np.zeros(self.scene.nq), np.zeros(len(self.robot.joints), np.float32)
        for name, angle in OUT.items():
            joints[self.robot.joints.index(name)] = angle
        qpos[joint_addresses(self.scene)] = joints
        tool = np.asarray(tool_poses(self.robot, jnp.asarray(joints))[0])[HAND] + np.array(BASE)
        along = self.scene.rope_part.root_offset + (0.5 - HELD) * LENGTH
        qpos[self.scene.layout.places["rope"].qpos] = [tool[0] + along, tool[1], tool[2], 1, 0, 0, 0]
        count = len(HALVES)
        far = (
            jnp.tile(jnp.array([0.0, 0.0, -10.0]), (count, 1)),
            jnp.tile(jnp.array([1.0, 0, 0, 0]), (count, 1)),
        )
        state = at_rest(self.scene, jnp.asarray(qpos, jnp.float32), *far)
        state = grasped(self.scene, graspable(self.scene, state), HAND, HELD)
        periods = round(SETTLING / self.scene.control_period)
        still = jnp.zeros((1, periods, self.scene.layout.driven.size))
        last, _ = self.simulator.rollout(jax.tree.map(lambda leaf: leaf[None], state), still)
        return jax.tree.map(lambda leaf: leaf[0], last)

    def drawn(self, seed: int, number: int) -> Reaching:
        """Scene ``number`` of a seed: the first that is drawn, has a box in the way and can be solved.

        Raises:
            RuntimeError: none of very many can be.
        """
        state = self.settled
        seen = self.simulator.observation(state)
        rope, hangs = rope_ends(self.scene, seen), self.end(seen) - seen.hands[HAND]
        random = generator(seed, "arm_reaching", "scene", str(number))
        spread = np.full(len(self.robot.joints), SPREAD[2])
        spread[:2] = SPREAD[:2]
        spread[[i for i in range(len(spread)) if i not in self.moving]] = 0
        for _ in range(100):
            joints = np.clip(
                np.asarray(seen.state.joints) + random.uniform(-spread, spread, (DRAWS, len(spread))),
                self.robot.low,
                self.robot.high,
            ).astype(np.float32)
            centres = random.uniform(*REGION, (DRAWS, len(HALVES), 3)).astype(np.float32)
            beside = random.uniform(-BESIDE, BESIDE, (DRAWS, 3)).astype(np.float32)
            part = random.uniform(*IN_THE_WAY, DRAWS).astype(np.float32)
            good, goals, placed = _solvable(
                *(self.scene, self.robot, jnp.asarray(joints), jnp.asarray(centres), jnp.asarray(part)),
                *(jnp.asarray(beside), seen.state.joints, rope, hangs),
            )
            if bool(good.any()):
                first = int(jnp.argmax(good))
                state = eqx.tree_at(lambda s: s.obstacle_position, state, placed[first])
                return Reaching(state, np.asarray(goals[first]))
        raise RuntimeError(f"none of {100 * DRAWS} scenes of arm_reaching that were drawn can be solved")


@eqx.filter_jit
def _solvable(
    own: Scene,
    robot: Robot,
    joints: Float[Array, "N J"],
    centres: Float[Array, "N B 3"],
    part: Float[Array, "N"],
    beside: Float[Array, "N 3"],
    start: Float[Array, "J"],
    rope: Float[Array, "P 3"],
    hangs: Float[Array, "3"],
) -> tuple[Bool[Array, "N"], Float[Array, "N 3"], Float[Array, "N B 3"]]:
    """Whether all is free at the start and at a posture whose cable hangs as then, but not the straight way.

    And where the cable's end is at that posture, and the boxes are.
    """
    upright = jnp.tile(jnp.array([1.0, 0, 0, 0]), (len(HALVES), 1))
    shift, count = jnp.array(BASE), len(rope)

    def one(posture: Array, centre: Array, part: Array, beside: Array) -> tuple[Array, Array, Array]:
        hand = tool_poses(robot, posture)[0][HAND] + shift
        moved = rope + (hand + hangs - rope[-1])
        centre = centre.at[0].set(rope[-1] + part * (moved[-1] - rope[-1]) + beside)
        boxes = obstacles_at(own, centre, upright)
        seen = eqx.tree_at(lambda o: o.centre, boxes, boxes.centre - shift)
        apart = jnp.stack(
            [obstacle_distances(robot, at, seen).min() for at in (start, posture)]
            + [floor_distances(robot, posture, -BASE[2]).min()]
            + [
                segment_signed_distance(boxes, points[: count - 1], points[1:]).min() - RADIUS
                for points in (rope, moved)
            ]
            + [moved[:, 2].min() - RADIUS]
        )
        met = segment_signed_distance(boxes, rope[-1:], moved[-1:]).min() < 0
        met &= self_distance(robot, posture) > MARGIN
        return (apart.min() > FREE) & met, moved[-1], centre

    return jax.lax.map(lambda every: one(*every), (joints, centres, part, beside), batch_size=16)


def _no_start(key: Array) -> SimState:
    raise ValueError("starts of arms are drawn outside of jit: doojax.tasks.arm_reaching.ArmReaching.drawn")
