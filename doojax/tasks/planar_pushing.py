"""Push nine cylinders about a table with a hand that is one, too (thesis section 3.4.1)."""

from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.goals import Goal, goal_of
from doojax.modules import Jittable
from doojax.simulation.scenes import Cylinder, Gripper, Scene, SolverSettings
from doojax.simulation.state import Fault, SimState, at_rest
from doojax.tasks.base import Box, Phase, check_phase
from doojax.types import Obstacles, PushingState

CYLINDERS, RADIUS, HEIGHT, DENSITY, FRICTION = 9, 0.02, 0.04, 1000.0, 0.4
MAX_STEP = 0.005  # m, of a move along x and along y
GAP = 0.001  # m, between any two at the start
ARRANGEMENTS = 16  # drawn, of which the first without overlap counts
TRIES = 64  # of each body in an arrangement
SPREAD = 0.09  # m either way, of the cylinders at the start
EXTENT = Box((-0.08, -0.08, RADIUS), (0.08, 0.08, RADIUS))  # of the hand's targets
WORKSPACE = Box((-0.25, -0.25, 0.0), (0.25, 0.25, 2 * RADIUS))


def default_scene() -> Scene:
    """Nine cylinders of 4 cm and a hand of that width, which goes at most 7 mm in 0.24 s, slowly.

    The released code's arm follows each target for up to two seconds and stops. At 5 cm/s nothing coasts
    here, so that pushing is as quasi-static, and every period ends at rest.
    """
    mass = 3.14159 * RADIUS**2 * HEIGHT * DENSITY
    return Scene(
        name="planar_pushing",
        rope_model=None,
        rope=None,
        grippers=(Gripper(link=None, end=0, radius=RADIUS, max_force=20.0, max_speed=0.05),),
        timestep=0.004,
        substeps=60,
        solver=SolverSettings(max_contact_points=32),
        cylinders=(Cylinder(RADIUS, HEIGHT, mass, FRICTION),) * CYLINDERS,
    )


class PushingStart(Jittable):
    """Draws where cylinders and hand stand at first: uniformly, without overlap."""

    scene: Scene = eqx.field(static=True)

    def __call__(self, key: Array) -> SimState:
        """A start; `Fault.SCENE_OVERFULL` where no arrangement was found."""
        place_key, yaw_key = jax.random.split(key)
        places, apart = jax.vmap(self._arrangement)(jax.random.split(place_key, ARRANGEMENTS))
        chosen = places[jnp.argmax(apart)]
        layout = self.scene.layout
        yaw = jax.random.uniform(yaw_key, (CYLINDERS, 1), minval=-jnp.pi, maxval=jnp.pi)
        cylinders = jnp.concatenate([chosen[:-1], jnp.zeros((CYLINDERS, 1)), yaw], axis=1)
        qpos = jnp.zeros(layout.nq).at[layout.places["cylinders"].qpos].set(cylinders)
        qpos = qpos.at[layout.driven].set(chosen[-1:])
        start = at_rest(self.scene, qpos, jnp.zeros((0, 3)), jnp.zeros((0, 4)))
        faults = jnp.where(apart.any(), 0, int(Fault.SCENE_OVERFULL)).astype(jnp.int32)
        return eqx.tree_at(lambda s: s.faults, start, faults)

    def _arrangement(self, key: Array) -> tuple[Float[Array, "N1 2"], Bool[Array, ""]]:
        """Places of all cylinders, one after the other, then of the hand; are all of them apart?"""
        spread = jnp.where(jnp.arange(CYLINDERS + 1) < CYLINDERS, SPREAD, EXTENT.high[0])

        def try_out(key: Array, spread: Array) -> Array:
            return jax.random.uniform(key, (TRIES, 2), minval=-spread, maxval=spread)

        def put(carry: tuple[Array, Array], given: tuple[Array, Array]) -> tuple:
            places, apart = carry
            tried, index = given
            gaps = jnp.linalg.norm(tried[:, None] - places[None], axis=-1)
            free = (jnp.where(jnp.arange(len(places)) < index, gaps, jnp.inf) > 2 * RADIUS + GAP).all(1)
            return (places.at[index].set(tried[jnp.argmax(free)]), apart & free.any()), None

        tried = jax.vmap(try_out)(jax.random.split(key, CYLINDERS + 1), spread)
        begin = jnp.zeros((CYLINDERS + 1, 2)), jnp.array(True)
        (places, apart), _ = jax.lax.scan(put, begin, (tried, jnp.arange(CYLINDERS + 1)))
        return places, apart


@dataclass(frozen=True)
class HandSteps:
    """Short moves (m) of one hand in the plane, kept for long: an `doojax.actions.ActionSpace`."""

    longest: float = 2**0.5 * MAX_STEP
    repeats: float = 0.99

    def draw(self, key: Array) -> Float[Array, "1 3"]:
        """Uniform in x and in y."""
        move = jax.random.uniform(key, (1, 2), minval=-MAX_STEP, maxval=MAX_STEP)
        return jnp.concatenate([move, jnp.zeros((1, 1))], axis=1)

    def valid(self, state: PushingState, action: Float[Array, "1 3"]) -> Bool[Array, ""]:
        """Is the move short enough, and its target within 8 cm of the middle along both axes?"""
        target = (state.hand + action[0]).at[2].set(RADIUS)
        short = jnp.linalg.norm(action) <= (1 + 1e-5) * self.longest  # but for rounding
        return EXTENT.contains(target) & short

    def retreat(self, state: PushingState) -> Float[Array, "1 3"]:
        """To the nearest point of the hand's extent, or as far towards it as a move goes."""
        way = (EXTENT.clip(state.hand) - state.hand).at[2].set(0.0)
        return jnp.clip(way, -MAX_STEP, MAX_STEP)[None]

    def missing(
        self, state: PushingState, action: Float[Array, "1 3"], aim: Float[Array, "K 3"]
    ) -> Float[Array, ""]:
        """Square metres between where the hand is sent and where ``aim`` has it."""
        return ((aim[-1] - state.hand - action[0]) ** 2).sum()

    def between(self, state: PushingState, later: PushingState, steps: int) -> Float[Array, "*b 1 3"]:
        """The straight way of the hand in so many equal moves."""
        return (later.hand - state.hand)[..., None, :] / max(steps, 1)


@dataclass(frozen=True)
class PlanarPushing:
    """One hand in the plane; the first cylinder is to come within 2 cm of a point.

    Dimensions, friction, starts and actions are those of the thesis's released code. There, the hand is the
    tip of an arm; here it is a free one. There are no obstacles but the cylinders, in either phase.
    """

    name: str = "planar_pushing"
    phase: Phase = "constrained"
    grippers: int = 1
    goal_threshold: float = 0.02
    goal_point: int = 0
    trajectory_states: int = 50
    actions: HandSteps = HandSteps()
    workspace: Box = WORKSPACE
    scene: Scene = field(default_factory=default_scene)

    @classmethod
    def of(cls, phase: Phase, crowd: int) -> "PlanarPushing":
        """The task in a phase.

        Raises:
            ValueError: for another crowd than 1.
        """
        if crowd != 1:
            raise ValueError(f"crowd is {crowd}, but planar_pushing has room for its nine cylinders only")
        return cls(phase=phase)

    @property
    def blank(self) -> PushingState:
        """A state of zeros."""
        return PushingState(jnp.zeros((CYLINDERS, 3)), jnp.zeros((CYLINDERS, 3)), jnp.zeros(3))

    def simulator(self, engine: str = "auto"):
        """The scene on an engine; see `Task.simulator`."""
        from doojax.simulation.engines import make_simulator

        check_phase(self.phase)
        return make_simulator(self.scene, PushingStart(self.scene), engine)

    def sample_goal(self, key: Array, obstacles: Obstacles) -> Goal:
        """Anywhere that cylinders start."""
        place = Box((-SPREAD, -SPREAD, RADIUS), (SPREAD, SPREAD, RADIUS)).sample(key)
        return goal_of([place], [[self.goal_point]], CYLINDERS + 1, self.goal_threshold)

    def reach(self) -> Float[np.ndarray, "K K"]:
        """Nothing holds the bodies together."""
        return np.where(np.eye(CYLINDERS + 1, dtype=bool), 0.0, np.inf)
