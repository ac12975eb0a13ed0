"""MuJoCo C through `mujoco.rollout`: threads over the batch, the fastest engine on a CPU."""

import contextlib
import copy
from collections.abc import Iterator
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco.rollout import Rollout

from doojax.parts import processors
from doojax.simulation.build import build_model
from doojax.simulation.layout import (
    Layout,
    Observation,
    clearance,
    gripper_targets,
    read_observation,
    stretch,
)
from doojax.simulation.scenes import Scene, obstacles_at
from doojax.simulation.state import SimState, Start, find_faults
from doojax.types import Obstacles, RopeState, Trajectory

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
BATCH = 64  # elements advanced together: their states of one control period stay in cache


class MujocoSimulator:
    """One scene on MuJoCo C; see `doojax.simulation.Simulator`. Runs outside jit."""

    def __init__(self, scene: Scene, start: Start, threads: int | None = None):
        """Compile ``scene``; ``start(key)`` draws a SimState; ``threads``: by default one per processor."""
        self.scene = scene
        self._start = jax.jit(lambda key: start(key))
        self._model = build_model(scene)
        self.layout = Layout.of(scene, self._model)
        self._data = mujoco.MjData(self._model)
        threads = processors() if threads is None else threads
        self._pool = Rollout(nthread=threads)
        self._pool_data = [copy.copy(self._data) for _ in range(max(threads, 1))]
        self._models = [copy.copy(self._model) for _ in range(BATCH)]

    def reset(self, key: Array) -> SimState:
        """A start drawn from the task's distribution."""
        return self._start(key)

    def step(self, state: SimState, action: Float[Array, "G 3"]) -> SimState:
        """One control period: move each gripper by ``action`` (m, world axes) at bounded speed and force."""
        batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], state)
        last, _ = self.rollout(batch, jnp.asarray(action)[None, None])
        return jax.tree.map(lambda leaf: leaf[0], last)

    def observe(self, state: SimState) -> RopeState:
        """Link centres and gripper positions, world frame, metres."""
        return self.observation(state).rope

    def observation(self, state: SimState) -> Observation:
        """What `observe` gives, and the directions of the links and the points held."""
        batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], state)
        return jax.tree.map(lambda leaf: leaf[0], self.observations(batch))

    def observations(self, states: SimState) -> Observation:
        """`observation` of a batch."""
        host, poses = jax.tree.map(np.asarray, states), []
        for index in range(states.qpos.shape[0]):
            model = self._load(0, jax.tree.map(lambda leaf, i=index: leaf[i], host))
            poses.append(self._poses(model, np.asarray(host.qpos)[index : index + 1]))
        return jax.tree.map(lambda leaf: leaf[:, 0], self._read(poses))

    def obstacles(self, state: SimState) -> Obstacles:
        """The primitives of the obstacles where they are."""
        return obstacles_at(self.scene, state.obstacle_position, state.obstacle_quaternion)

    def rollout(self, states: SimState, actions: Float[Array, "B T G 3"]) -> tuple[SimState, Trajectory]:
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
        self, states: SimState, actions: Float[np.ndarray, "B T G 3"]
    ) -> tuple[SimState, Trajectory]:
        batch, periods = actions.shape[:2]
        models = [self._load(i, jax.tree.map(lambda leaf, i=i: leaf[i], states)) for i in range(batch)]
        nq = self._model.nq
        history = np.zeros((batch, periods + 1, mujoco.mj_stateSize(self._model, STATE)))
        history[:, 0, 1:] = np.concatenate([states.qpos, states.qvel], axis=1)
        commands = np.asarray(actions, dtype=np.float64)[..., : self.layout.gripper_qpos.shape[1]]
        for period in range(periods):
            start = history[:, period, 1 + self.layout.gripper_qpos]
            targets = gripper_targets(self.scene, start, commands[:, period], xp=np)
            with _quiet():
                # one by one, because contacts make some elements several times as dear as others
                steps, _ = self._pool.rollout(
                    models, self._pool_data, history[:, period], targets, chunk_size=1
                )
            with np.errstate(over="ignore"):  # a state that blew up need not fit into single precision
                history[:, period + 1] = steps[:, -1].astype(np.float32)  # as SimState holds it: see rollout
        seen = self._read(
            [self._poses(model, own[:, 1 : 1 + nq]) for model, own in zip(models, history, strict=True)]
        )
        measured = _measured(self.scene, states, seen)
        physics = history[:, :, 1:].astype(np.float32)
        qpos, qvel = physics[..., :nq], physics[..., nq:]
        faults = _faults(qpos[:, 1:], qvel[:, 1:])
        last = eqx.tree_at(
            lambda s: (s.qpos, s.qvel, s.faults), states, (qpos[:, -1], qvel[:, -1], faults[:, -1])
        )
        return last, Trajectory(seen.rope, jnp.asarray(actions), faults, *measured)

    def _load(self, index: int, state: SimState) -> mujoco.MjModel:
        """The model of batch element ``index``, with what varies by element written into it."""
        write_state(self._models[index], state)
        return self._models[index]

    def _poses(self, model: mujoco.MjModel, qpos: Float[np.ndarray, "K nq"]) -> list[np.ndarray]:
        """Geometry sizes and the poses of bodies and sites, K times each."""
        data, poses = self._data, []
        for own in qpos:
            data.qpos[:] = own
            mujoco.mj_kinematics(model, data)
            poses.append((model.geom_size, data.xpos.copy(), data.xmat.copy(), data.site_xpos.copy()))
        return [np.stack(values) for values in zip(*poses, strict=True)]

    def _read(self, poses: list[list[np.ndarray]]) -> Observation:
        with np.errstate(over="ignore"):  # a state that blew up need not fit into single precision
            sizes, xpos, xmat, sites = (
                np.stack(values, dtype=np.float32, casting="same_kind") for values in zip(*poses, strict=True)
            )
        xmat = xmat.reshape(*xpos.shape, 3)
        return _observed(self.layout, sizes, xpos, xmat, sites)


_observed = jax.jit(read_observation, static_argnums=0)
_faults = jax.jit(lambda qpos, qvel: find_faults(qpos, qvel).astype(jnp.int32))


@partial(jax.jit, static_argnums=0)
def _measured(scene: Scene, states: SimState, seen: Observation) -> tuple[Array, Array]:
    """Clearance and stretch of B elements at T + 1 times."""

    def one(state: SimState, seen: Observation) -> tuple[Array, Array]:
        obstacles = obstacles_at(scene, state.obstacle_position, state.obstacle_quaternion)
        return (
            jax.vmap(lambda o: clearance(scene, obstacles, o))(seen),
            jax.vmap(lambda o: stretch(scene, state.holding, o))(seen),
        )

    return jax.vmap(one)(states, seen)


def write_state(model: mujoco.MjModel, state: SimState) -> None:
    """Write into ``model`` what varies by element, besides positions and velocities.

    `mujoco.rollout` reads the poses of mocap bodies and the active equalities from the model.
    """
    mocap = model.body_mocapid >= 0
    for name, values in state.model_fields.items():
        getattr(model, name)[:] = values
    model.body_pos[mocap] = state.obstacle_position
    model.body_quat[mocap] = state.obstacle_quaternion
    model.eq_active0[model.neq - len(state.holding) :] = state.holding


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT: what goes wrong is reported as faults."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
