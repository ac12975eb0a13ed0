"""A scene of arms and a rope: read, settled in batches, and executed with all that happens kept."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from doojax.robots import Robot
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.grasps import grasp_places, released
from doojax.simulation.parts.arms import LEAD
from doojax.simulation.state import Fault, SimState
from doojax.tasks.arms import BASE, ArmTask, Start, held_at, joint_addresses, rope_ends
from doojax.topology.skeletons import Skeleton
from doojax.types import Obstacles

CHUNK = 8  # states that are simulated together: one shape, compiled once
LOOK = 3  # control periods between two looks at whether all is at rest
RESTING = (0.01, np.deg2rad(1.0))  # m and rad, that rope and joints move at most in a period at rest
LONGEST = 5.0  # s, until what still moves counts as at rest
REACH = 0.05  # m, between a tool and what it grasps
ARRIVED = np.deg2rad(1.0)  # rad, of every joint from where it was sent
LAG = 0.1  # rad, that a joint may be behind while others go on
MOST_WAITED = 75  # control periods for each line, as in the thesis's code
WAITING = 10  # control periods in which joints may still arrive

BROKEN = int(Fault.NOT_FINITE | Fault.UNSTABLE)  # other faults are let pass


class Seen(NamedTuple):
    """What is known of states; lengths in the base's frame, m."""

    joints: Float[np.ndarray, "*b J"]
    rope: Float[np.ndarray, "*b N1 3"]  # where its links meet
    hands: Float[np.ndarray, "*b G 3"]


class World:
    """One scene of a task on MuJoCo C."""

    def __init__(self, task: ArmTask, simulator: MujocoSimulator, start: Start):
        """Everything in the base's frame."""
        self.task, self.simulator, self.scene = task, simulator, task.scene
        self.robot: Robot = task.robot
        self.obstacles: Obstacles = task.obstacles(start.state)
        self.skeleton: Skeleton = task.skeleton(start.state)
        self.goal = np.asarray(start.goal, np.float32) - np.array(BASE, np.float32)
        self.fastened = np.asarray(
            start.state.obstacle_position[
                [one.name for one in self.scene.obstacles].index(self.scene.attachments[0].obstacle)
            ]
        ) - np.array(BASE, np.float32)
        self.floor = -BASE[2]

    def seen(self, states: SimState) -> Seen:
        """A batch."""
        observed = self.simulator.observations(states)
        base = np.array(BASE, np.float32)
        return Seen(
            np.asarray(observed.state.joints),
            np.asarray(rope_ends(self.scene, observed)) - base,
            np.asarray(observed.hands) - base,
        )

    def seen_one(self, state: SimState) -> Seen:
        """One state."""
        return Seen(*(values[0] for values in self.seen(stacked([state]))))

    def places(self, state: SimState) -> tuple[float, ...]:
        """Where along the rope each hand holds it; NaN for one that does not."""
        return tuple(float(place) for place in grasp_places(self.scene, state))

    def held(self, state: SimState, hand: int, place: float) -> SimState:
        """The state in which a hand holds the rope at a place."""
        return held_at(self.simulator, as_jax(state), hand, place)

    def after(self, state: SimState, action: Float[np.ndarray, "A"], seconds: float) -> tuple[SimState, bool]:
        """The state after an action of so many seconds, and whether the simulation broke down."""
        periods = round(seconds / self.scene.control_period)
        actions = jnp.asarray(np.tile(np.asarray(action, np.float32), (1, periods, 1)))
        batch, trajectory = self.simulator.rollout(stacked([state]), actions)
        return unstacked(batch)[0], bool(np.asarray(trajectory.faults & BROKEN).any())

    def settled(self, states: list[SimState]) -> tuple[list[SimState], Bool[np.ndarray, "K"]]:
        """States at rest, arms commanded to stay; and which are at fault. All side by side."""
        found, faults = [], []
        for first in range(0, len(states), CHUNK):
            own = states[first : first + CHUNK]
            batch = stacked([*own, *[own[-1]] * (CHUNK - len(own))])
            batch, fault = self._settled(batch)
            found += unstacked(batch)[: len(own)]
            faults += fault[: len(own)].tolist()
        return found, np.array(faults, bool)

    def _settled(self, batch: SimState) -> tuple[SimState, Bool[np.ndarray, "K"]]:
        still = jnp.zeros((CHUNK, LOOK, len(self.scene.layout.driven)))
        faulty = np.zeros(CHUNK, bool)
        for _ in range(round(LONGEST / self.scene.control_period / LOOK)):
            batch, trajectory = self.simulator.rollout(batch, still)
            faulty |= np.asarray(trajectory.faults & BROKEN).any(1)
            points, joints = (
                np.abs(np.diff(np.asarray(getattr(trajectory.states, name))[:, -2:], axis=1)).max()
                for name in ("points", "joints")
            )
            if (points < RESTING[0] and joints < RESTING[1]) or faulty.all():
                break
        return batch, faulty


def stacked(states: list[SimState]) -> SimState:
    """A batch of states."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *states)


def unstacked(states: SimState) -> list[SimState]:
    """The states of a batch."""
    count = len(jax.tree.leaves(states)[0])
    host = jax.tree.map(np.asarray, states)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], host) for i in range(count)]


class Executed:
    """A trial's execution: the present state, and every control period until now.

    From the first state, actions and grasps of all periods the same states follow again, see `repeated`.
    """

    def __init__(self, world: World, state: SimState):
        """Begin."""
        self.world, self.first, self.state = world, state, state
        self.actions: list[np.ndarray] = []
        self.held: list[tuple[float, ...]] = []  # places, during each period
        seen = world.seen_one(state)
        base = np.array(BASE, np.float32)
        self.ropes, self.hands, self.joints = [seen.rope + base], [seen.hands + base], [seen.joints]
        self.fault = False

    def act(self, action: Float[np.ndarray, "A"], periods: int = 1) -> None:
        """Command velocities, rad/s, for some control periods."""
        for _ in range(periods):
            self.held.append(self.world.places(self.state))
            self.actions.append(np.asarray(action, np.float32))
            batch, trajectory = self.world.simulator.rollout(
                stacked([self.state]), jnp.asarray(action, jnp.float32)[None, None]
            )
            self.state = unstacked(batch)[0]
            self.fault |= bool(np.asarray(trajectory.faults & BROKEN).any())
            seen, base = self.world.seen_one(self.state), np.array(BASE, np.float32)
            self.ropes.append(seen.rope + base)
            self.hands.append(seen.hands + base)
            self.joints.append(seen.joints)

    def settle(self) -> None:
        """Wait until all is at rest."""
        still = np.zeros(len(self.world.scene.layout.driven))
        for _ in range(round(LONGEST / self.world.scene.control_period / LOOK)):
            self.act(still, LOOK)
            moved = (
                np.abs(self.ropes[-1] - self.ropes[-2]).max(),
                np.abs(self.joints[-1] - self.joints[-2]).max(),
            )
            if (moved[0] < RESTING[0] and moved[1] < RESTING[1]) or self.fault:
                return

    def follow(self, waypoints: Float[np.ndarray, "W J"]) -> bool:
        """Move the joints along straight lines, at their largest speeds at most; whether they arrive.

        Each line takes a whole number of control periods, so that corners are not cut; and as long as a joint
        lags behind by more than `LAG`, which drives of bounded force do, all wait for it.
        """
        task, period = self.world.task, self.world.scene.control_period
        moving, at = np.array(task.moving), np.array(task.actuated)
        speed = np.asarray(task.robot.speed)[moving]
        begin = np.asarray(self.state.commanded)[at]
        for waypoint in np.asarray(waypoints)[:, moving]:
            ticks = int(np.ceil((np.abs(waypoint - begin) / speed).max() / period - 1e-6))
            tick = waited = 0
            while tick < ticks and waited < MOST_WAITED and not self.fault:
                aim = begin + (tick + 1) / ticks * (waypoint - begin)
                self._send(aim, at)
                behind = np.abs(np.asarray(self.joints[-1])[moving] - aim).max() > LAG
                tick, waited = (tick, waited + 1) if behind else (tick + 1, waited)
            begin = waypoint
        for _ in range(WAITING):
            if np.abs(np.asarray(self.joints[-1])[moving] - begin).max() < ARRIVED or self.fault:
                break
            self._send(begin, at)
        return bool(np.abs(np.asarray(self.joints[-1])[moving] - begin).max() < 5 * ARRIVED)

    def _send(self, target: np.ndarray, at: np.ndarray) -> None:
        now = np.asarray(self.state.qpos)[self.world.scene.layout.driven]
        start = np.clip(np.asarray(self.state.commanded), now - LEAD, now + LEAD)
        action = np.zeros(len(start))
        action[at] = (target - start[at]) / self.world.scene.control_period
        self.act(action)

    def release(self, hand: int) -> None:
        """Let go."""
        self.state = released(self.world.scene, as_jax(self.state), hand)

    def grasp(self, hand: int, place: float) -> float:
        """Hold the rope there if the hand is near enough, and say how far it was, m."""
        seen = self.world.seen_one(self.state)
        gap = float(np.linalg.norm(point_of(seen.rope, place) - seen.hands[hand]))
        if gap <= REACH:
            self.state = self.world.held(self.state, hand, place)
        return gap


def as_jax(state: SimState) -> SimState:
    """The same, as arrays of JAX."""
    return jax.tree.map(jnp.asarray, state)


def point_of(rope: Float[np.ndarray, "N1 3"], place: float) -> Float[np.ndarray, "3"]:
    """The point of a rope at a place, see `doojax.planning.regrasp.points_at`."""
    links = len(rope) - 1
    link = min(int(place * links), links - 1)
    return rope[link] + (place * links - link) * (rope[link + 1] - rope[link])


def repeated(world: World, first: SimState, actions: Any, held: Any) -> Float[np.ndarray, "T1 N1 3"]:
    """The rope (world frame, m) when recorded actions and grasps are executed again from the first state."""
    execution = Executed(world, first)
    for action, places in zip(actions, held, strict=True):
        for hand, (place, now) in enumerate(zip(places, world.places(execution.state), strict=True)):
            if np.isnan(place) and not np.isnan(now):
                execution.release(hand)
            elif not np.isnan(place) and not np.isclose(place, now, atol=1e-6):
                execution.state = world.held(execution.state, hand, float(np.float32(place)))
        execution.act(action)
    return np.stack(execution.ropes)


def joints_of(world: World, state: SimState) -> np.ndarray:
    """The robot's joints, rad."""
    return np.asarray(state.qpos)[joint_addresses(world.scene)]
