"""MuJoCo C through `mujoco.rollout`: threads over the batch, the fastest engine on a CPU."""

import contextlib
import copy
import threading
from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco.rollout import Rollout

from doojax.parts import processors
from doojax.simulation.build import build_model
from doojax.simulation.grasps import FIELD as GRASPS
from doojax.simulation.layout import Layout, Observation, look_every, observe, stretch, watch
from doojax.simulation.rope import link_name
from doojax.simulation.scenes import Scene, obstacles_at
from doojax.simulation.state import Fault, SimState, Start, find_faults
from doojax.types import Obstacles, Trajectory

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
BATCH = 64  # elements advanced together: their states of one control period stay in cache


class MujocoSimulator:
    """One scene on MuJoCo C; see `doojax.simulation.Simulator`. Runs outside jit."""

    def __init__(self, scene: Scene, start: Start, threads: int | None = None):
        """Compile ``scene``; ``start(key)`` draws a SimState; ``threads``: by default one per processor."""
        self.scene = scene
        self._start = jax.jit(lambda key: start(key))
        self._model = build_model(scene, with_sensors=True)
        self.layout = Layout.of(scene, self._model)
        self._data = mujoco.MjData(self._model)
        threads = processors() if threads is None else threads
        self._pool = Rollout(nthread=threads)
        self._pool_data = [copy.copy(self._data) for _ in range(max(threads, 1))]
        self._models = [copy.copy(self._model) for _ in range(BATCH)]  # of the scene's own rope
        self._looks = range(0, scene.substeps, look_every(scene))

    def reset(self, key: Array) -> SimState:
        """A start drawn from the task's distribution."""
        return self._start(key)

    def step(self, state: SimState, action: Float[Array, "*action"]) -> SimState:
        """One control period: move each hand by ``action`` [G, 3] (m, world axes), at bounded speed."""
        batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], state)
        last, _ = self.rollout(batch, jnp.asarray(action)[None, None])
        return jax.tree.map(lambda leaf: leaf[0], last)

    def observe(self, state: SimState) -> Any:
        """What learners and planners see, such as a `doojax.types.RopeState`."""
        return self.observation(state).state

    def observation(self, state: SimState) -> Observation:
        """What `observe` gives, and a rope's shape."""
        batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], state)
        return jax.tree.map(lambda leaf: leaf[0], self.observations(batch))

    def observations(self, states: SimState) -> Observation:
        """`observation` of a batch."""
        host, looks, sizes = jax.tree.map(np.asarray, states), [], []
        for index in range(states.qpos.shape[0]):
            model = self._load(0, _element(host, index))
            looks.append(self._look(model, host.qpos[index]))
            sizes.append(self._sizes(model))
        coordinates = np.concatenate([host.qpos, host.qvel], axis=1)[:, self.layout.coordinates]
        looked = _single(np.stack(looks)).reshape(len(looks), -1, 3)
        return _seen(self.scene, self.layout, looked, coordinates, _single(np.stack(sizes)))

    def turn_in_hand(self, state: SimState, hand: int, place: float) -> Float[np.ndarray, "4"]:
        """How the link at ``place`` (0 to 1 along the rope) is turned in a hand's frame: a unit quaternion.

        For rigid holds, see `doojax.simulation.grasps.grasped`.
        """
        self._look(self._load(0, jax.tree.map(np.asarray, state)), np.asarray(state.qpos))
        link = min(int(place * self.scene.links), self.scene.links - 1)
        names = self.scene.driver.bodies[hand], link_name(link)
        first, second = (self._data.xquat[self._model.body(name).id] for name in names)
        back, found = np.zeros(4), np.zeros(4)
        mujoco.mju_negQuat(back, first)
        mujoco.mju_mulQuat(found, back, second)
        return found.astype(np.float32)

    def obstacles(self, state: SimState) -> Obstacles:
        """The primitives of the obstacles where they are."""
        return obstacles_at(self.scene, state.obstacle_position, state.obstacle_quaternion)

    def rollout(self, states: SimState, actions: Float[Array, "B T *action"]) -> tuple[SimState, Trajectory]:
        """T control periods of B elements: the bulk path. Returns the last states and all that was seen.

        Two periods in one call equal two calls with one, bit for bit: a trajectory can be replayed from its
        first state and its actions.
        """
        host, parts = jax.tree.map(np.asarray, (states, actions)), []
        for first in range(0, len(actions), BATCH):
            part = jax.tree.map(lambda leaf, f=first: leaf[f : f + BATCH], host)
            parts.append(self._rollout_part(*part))
        return jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *parts)

    def _rollout_part(
        self, states: SimState, actions: Float[np.ndarray, "B T *action"]
    ) -> tuple[SimState, Trajectory]:
        batch, periods = actions.shape[:2]
        models = [self._load(i, _element(states, i)) for i in range(batch)]
        now = np.zeros((batch, mujoco.mj_stateSize(self._model, STATE)))
        now[:, 1:] = np.concatenate([states.qpos, states.qvel], axis=1)
        commanded, looks, ways, ends = states.commanded, [], [], []
        commands, nq, seen_of = actions.astype(np.float64), self._model.nq, 1 + self.layout.coordinates
        for period in range(periods):
            driven = now[:, 1 + self.layout.driven]
            controls, commanded = self.scene.driver.drive(
                self.scene, driven, commanded, commands[:, period], xp=np
            )
            commanded = commanded.astype(np.float32)
            begin = now[:, None, seen_of]
            with _quiet():
                # one by one, because contacts make some elements several times as dear
                steps, sensed = self._pool.rollout(models, self._pool_data, now, controls, chunk_size=1)
            now[:, 1:] = _single(steps[:, -1, 1:])  # as SimState holds it: see rollout
            looks.append(sensed[:, self._looks])
            # sensors are those of a step's beginning, states those of its end
            on_the_way = steps[:, np.array(self._looks)[1:] - 1][..., seen_of]
            ways.append(np.concatenate([begin, on_the_way], axis=1))
            ends.append(now[:, 1:].astype(np.float32))
        final = [self._look(model, own[1 : 1 + nq]) for model, own in zip(models, now, strict=True)]
        sizes = _single(np.stack([self._sizes(model) for model in models]))
        looked = _single(np.concatenate([*looks, np.stack(final)[:, None]], axis=1))
        looked = looked.reshape(*looked.shape[:2], -1, 3)
        coordinates = _single(np.concatenate([*ways, now[:, None, seen_of]], axis=1))
        seen, measured, entered = _measured(
            self.scene, self.layout, states, sizes, looked, coordinates, periods
        )
        qpos, qvel = np.split(np.stack(ends, 1), [nq], axis=-1)
        faults = _faults(qpos, qvel, entered)
        last = eqx.tree_at(
            lambda s: (s.qpos, s.qvel, s.commanded, s.faults),
            states,
            (qpos[:, -1], qvel[:, -1], commanded, faults[:, -1]),
        )
        return last, Trajectory(seen, jnp.asarray(actions), faults, *measured)

    def _load(self, index: int, state: SimState) -> mujoco.MjModel:
        """A model of batch element ``index``, with what varies by element written into it."""
        # another rope gets a model of its own: what is written into the others, every call writes anew
        own = bool(set(state.model_fields) - {GRASPS})
        model = copy.copy(self._model) if own else self._models[index]
        if not own:
            model.eq_data[:] = self._model.eq_data
        write_state(model, self.layout, state)
        return model

    def _sizes(self, model: mujoco.MjModel) -> np.ndarray:
        return model.geom_size[self.layout.sizes, :2]

    def _look(self, model: mujoco.MjModel, qpos: Float[np.ndarray, "nq"]) -> np.ndarray:
        """The values of the sensors at these positions."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(model, self._data)
        mujoco.mj_sensorPos(model, self._data)
        return self._data.sensordata.copy()


def _element(tree: SimState, index: int) -> SimState:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _single(values: np.ndarray) -> np.ndarray:
    """In single precision, into which a state that blew up need not fit."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)


@jax.jit
def _faults(qpos: Array, qvel: Array, entered: Array) -> Array:
    return find_faults(qpos, qvel) + jnp.where(entered, int(Fault.PASSED_THROUGH), 0).astype(jnp.int32)


@partial(jax.jit, static_argnums=(0, 1))
def _seen(scene: Scene, layout: Layout, looks: Array, coordinates: Array, sizes: Array) -> Observation:
    return observe(scene, layout, looks, coordinates, sizes)


@partial(jax.jit, static_argnums=(0, 1, 6))
def _measured(
    scene: Scene,
    layout: Layout,
    states: SimState,
    sizes: Array,
    looks: Array,
    coordinates: Array,
    periods: int,
) -> tuple[Any, tuple[Array, Array], Array]:
    """Of B elements: states and (clearance, stretch) at T + 1 times; did they enter an obstacle, T times?"""
    every = (looks.shape[1] - 1) // periods
    sizes = jnp.broadcast_to(sizes[:, None], (*looks.shape[:2], *sizes.shape[1:]))
    seen = observe(scene, layout, looks, coordinates, sizes)
    obstacles = jax.vmap(partial(obstacles_at, scene))(states.obstacle_position, states.obstacle_quaternion)
    near, entered = watch(scene, obstacles, seen, periods)
    ends = jax.tree.map(lambda leaf: leaf[:, ::every], seen)
    stretched = jax.vmap(lambda holding, own: jax.vmap(lambda o: stretch(scene, holding, o))(own))
    return ends.state, (near, stretched(states.holding, ends)), entered


def write_state(model: mujoco.MjModel, layout: Layout, state: SimState) -> None:
    """Write into ``model`` what varies by element, besides positions and velocities.

    `mujoco.rollout` reads the poses of mocap bodies and the active equalities from the model.
    """
    mocap = model.body_mocapid >= 0
    for name, values in state.model_fields.items():
        getattr(model, name)[:] = values
    model.body_pos[mocap] = state.obstacle_position
    model.body_quat[mocap] = state.obstacle_quaternion
    model.eq_active0[layout.holds] = state.holding


_quiet_lock, _quiet_depth = threading.Lock(), 0


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT: what goes wrong is reported as faults.

    The handler of warnings is the process's: it is exchanged when the first of several threads begins, and
    put back when the last one ends.
    """
    global _quiet_depth, _loud
    with _quiet_lock:
        if _quiet_depth == 0:
            _loud = mujoco.get_mju_user_warning()
            mujoco.set_mju_user_warning(lambda message: None)
        _quiet_depth += 1
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_depth -= 1
            if _quiet_depth == 0:
                mujoco.set_mju_user_warning(_loud)


_loud = None
