"""A task as a pure environment: `reset`, `step`, `observe`, a reward and when it is over."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from doojax.environments.observations import action_size, features, taken
from doojax.goals import Goal
from doojax.keys import stream
from doojax.modules import Jittable
from doojax.simulation.scenes import obstacles_at, parked_poses
from doojax.simulation.state import Fault, SimState, Simulator
from doojax.tasks import make_task
from doojax.tasks.base import Phase, Task
from doojax.types import Obstacles

REACHED = 1.0  # the reward of reaching the goal, beside the way there
BROKEN = int(Fault.NOT_FINITE | Fault.UNSTABLE)


class EnvironmentState(eqx.Module):
    """All that an environment needs to go on, and what came of the last step; batch axes first."""

    simulation: SimState
    goal: Goal
    observation: Float[Array, "*b D"]  # see `doojax.environments.features`
    missing: Float[Array, "*b"]  # m to the goal, see `doojax.goals.Goal.distance`
    reward: Float[Array, "*b"]
    reached: Bool[Array, "*b"]
    done: Bool[Array, "*b"]  # reached, or the simulation became unstable; there is no limit of time


class Environment(Jittable):
    """One task on one engine.

    A step's reward is how much of the task's cost, the metres that are missing to the goal, it took away, in
    units of the longest action, plus `REACHED` at the goal: over a whole trajectory that is what was gained
    in all, however long it took. An action that the task's space calls invalid is not taken: its retreat is.

    `reset` and `step` are pure and of one element, to be vmapped, where the engine is (mjx, warp, toy's);
    `begin` and `advance` take batches on any engine, MuJoCo C included.
    """

    task: Task = eqx.field(static=True)
    simulator: Simulator

    def reset(self, key: Array) -> EnvironmentState:
        """A start and a goal, drawn as the task draws them."""
        start_key, goal_key = jax.random.split(key)
        simulation = self.simulator.reset(start_key)
        return _started(self.task, goal_key, simulation, self.simulator.observe(simulation))

    def step(self, state: EnvironmentState, action: Float[Array, "U"]) -> EnvironmentState:
        """One control period; what to do is U numbers from -1 to 1, see `doojax.environments.command`."""
        moved = taken(self.task, self.simulator.observe(state.simulation), action)
        simulation = self.simulator.step(state.simulation, moved)
        return _after(self.task, state, simulation, self.simulator.observe(simulation))

    def observe(self, state: EnvironmentState) -> Float[Array, "*b D"]:
        """What a policy sees of it."""
        return state.observation

    def begin(self, keys: Array) -> EnvironmentState:
        """`reset` of B elements; not inside of jit."""
        start_keys, goal_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        simulation = jax.vmap(self.simulator.reset)(start_keys)
        seen = self.simulator.observations(simulation).state
        return _batch_started(self.task, goal_keys, simulation, seen)

    def advance(self, states: EnvironmentState, actions: Float[Array, "B U"]) -> EnvironmentState:
        """`step` of B elements; not inside of jit."""
        seen = self.simulator.observations(states.simulation).state
        moved = _batch_taken(self.task, seen, actions)
        last, trajectory = self.simulator.rollout(states.simulation, moved[:, None])
        after = jax.tree.map(lambda leaf: leaf[:, -1], trajectory.states)
        return _batch_after(self.task, states, last, after)

    @property
    def observation_size(self) -> int:
        """D, the length of an observation."""
        return observation_size(self.task)

    @property
    def action_size(self) -> int:
        """U, how many numbers an action is."""
        return action_size(self.task.actions)


def make_environment(name: str, *, engine: str = "auto", phase: Phase = "constrained") -> Environment:
    """The task called ``name`` as an environment.

    Args:
        name: of the task, see `doojax.tasks.make_task`.
        engine: mujoco, mjx, warp or auto; brax, jit and vmap need mjx or warp, but for the task toy.
        phase: unconstrained (nothing in the way) or constrained.

    Raises:
        ValueError: for an unknown name, phase or engine.
    """
    task = make_task(name, phase=phase)
    return Environment(task, task.simulator(engine))


def observation_size(task: Task) -> int:
    """The length of a task's `doojax.environments.features`."""

    def one() -> Array:
        obstacles = obstacles_at(task.scene, *parked_poses(len(task.scene.obstacles)))
        return features(task, obstacles, task.blank, task.sample_goal(stream(0, "shape"), obstacles))

    return jax.eval_shape(one).shape[0]


def _obstacles(task: Task, simulation: SimState) -> Obstacles:
    return obstacles_at(task.scene, simulation.obstacle_position, simulation.obstacle_quaternion)


def _started(task: Task, goal_key: Array, simulation: SimState, seen: Any) -> EnvironmentState:
    obstacles = _obstacles(task, simulation)
    goal = task.sample_goal(goal_key, obstacles)
    missing = goal.distance(seen)
    return EnvironmentState(
        simulation=simulation,
        goal=goal,
        observation=features(task, obstacles, seen, goal),
        missing=missing,
        reward=jnp.zeros_like(missing),
        reached=missing <= goal.tolerance,
        done=jnp.zeros((), bool),
    )


def _after(task: Task, before: EnvironmentState, simulation: SimState, seen: Any) -> EnvironmentState:
    broken = (simulation.faults & BROKEN) != 0
    # of what became unstable, what was last seen and no reward: NaN would spoil all that is learned with it
    observation = features(task, _obstacles(task, simulation), seen, before.goal)
    observation = jnp.where(broken, before.observation, observation)
    missing = jnp.where(broken, before.missing, before.goal.distance(seen))
    reached = missing <= before.goal.tolerance
    gained = (before.missing - missing) / task.actions.longest
    return EnvironmentState(
        simulation=simulation,
        goal=before.goal,
        observation=observation,
        missing=missing,
        reward=gained + REACHED * (reached & ~broken),
        reached=reached & ~broken,
        done=reached | broken,
    )


@jax.jit
def chosen(mask: Bool[Array, "B"], yes: EnvironmentState, no: EnvironmentState) -> EnvironmentState:
    """Of B elements those of ``yes`` where the mask is true, else those of ``no``."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), yes, no)


@eqx.filter_jit
def _batch_started(task: Task, goal_keys: Array, simulation: SimState, seen: Any) -> EnvironmentState:
    return jax.vmap(partial(_started, task))(goal_keys, simulation, seen)


@eqx.filter_jit
def _batch_taken(task: Task, seen: Any, numbers: Float[Array, "B U"]) -> Float[Array, "B ..."]:
    return jax.vmap(partial(taken, task))(seen, numbers)


@eqx.filter_jit
def _batch_after(task: Task, before: EnvironmentState, simulation: SimState, seen: Any) -> EnvironmentState:
    return jax.vmap(partial(_after, task))(before, simulation, seen)
