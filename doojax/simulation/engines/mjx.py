"""MuJoCo MJX: pure functions that jit, vmap, scan and differentiate, on any device that JAX knows."""

import contextlib
import io
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.modules import Jittable
from doojax.parts import in_parts, worth_parts
from doojax.simulation.build import build_model
from doojax.simulation.layout import (
    Layout,
    Observation,
    gripper_targets,
    look_every,
    read_observation,
    stretch,
    watch,
)
from doojax.simulation.scenes import Scene, obstacles_at
from doojax.simulation.state import Fault, SimState, Start, find_faults
from doojax.types import Obstacles, RopeState, Trajectory

with contextlib.redirect_stdout(io.StringIO()):  # it prints that warp is missing, which is no fault
    from mujoco import mjx

PART = 16  # elements that a thread simulates at once on a CPU


class MjxSimulator(Jittable):
    """One scene on MJX; see `doojax.simulation.Simulator`."""

    model: mjx.Model
    data: mjx.Data  # a fresh state, of which a step replaces what SimState holds
    start: Start
    scene: Scene = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)

    def __init__(self, scene: Scene, start: Start, impl: Literal["jax", "warp"] = "jax"):
        """Put ``scene`` on JAX's default device; ``start(key)`` draws a SimState."""
        model = build_model(scene)
        self.scene, self.start, self.layout = scene, start, Layout.of(scene, model)
        if impl == "warp":
            from doojax.simulation.engines.warp import warp_data, warp_model

            made = warp_model(model), warp_data(scene, batch=1)
        else:
            made = mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
        # not committed to the device, unlike what MJX gives, lest states on other devices do not fit them
        self.model, self.data = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), made)

    def reset(self, key: Array) -> SimState:
        """A start drawn from the task's distribution."""
        return self.start(key)

    def step(self, state: SimState, action: Float[Array, "G 3"]) -> SimState:
        """One control period: move each gripper by ``action`` (m, world axes) at bounded speed and force."""
        return self._step(state, action)[0]

    def _step(
        self, state: SimState, action: Float[Array, "G 3"]
    ) -> tuple[SimState, Observation, Float[Array, "2"]]:
        """`step`, the K looks on the way, and `clearance` (m) before it and the least in it."""
        hands = state.qpos[self.layout.gripper_qpos]
        targets = gripper_targets(self.scene, hands, state.commanded, action[:, : hands.shape[-1]])
        advance = MjxSimulator._advance
        if self.model.impl == mjx.Impl.WARP:
            from doojax.simulation.engines.warp import for_any_batch

            qpos, qvel, looks, dropped = for_any_batch(self, advance)(state, targets)
        else:
            qpos, qvel, looks, dropped = advance(self, state, targets)
        alone = jax.tree.map(lambda leaf: leaf[None], (self.obstacles(state), looks))
        (near,), ((entered,),) = watch(self.scene, *alone, periods=1)
        faults = (
            find_faults(qpos, qvel)
            + jnp.where(dropped, int(Fault.CONTACTS_DROPPED), 0)
            + jnp.where(entered, int(Fault.PASSED_THROUGH), 0)
        )
        after = eqx.tree_at(
            lambda s: (s.qpos, s.qvel, s.commanded, s.faults),
            state,
            (qpos, qvel, targets[-1].astype(state.commanded.dtype), faults.astype(jnp.int32)),
        )
        return after, looks, near

    def _advance(
        self, state: SimState, targets: Float[Array, "S G D"]
    ) -> tuple[Array, Array, Observation, Bool[Array, ""]]:
        """One physics step per target: positions, velocities, looks on the way, were contacts dropped."""
        model, data = self._load(state)

        def substep(carry, target):
            before, dropped = carry
            data = mjx.step(model, before.replace(ctrl=target.reshape(-1)))
            # with 64-bit floats enabled, MJX also widens the indices of tendons
            data = jax.tree.map(lambda new, old: new.astype(old.dtype), data, before)
            return (data, dropped | self._contacts_dropped(data)), None

        def look(carry, targets):
            (data, dropped), _ = jax.lax.scan(substep, carry, targets)
            return (data, dropped), data.qpos

        every = look_every(self.scene)
        chunks = targets.reshape(-1, every, *targets.shape[1:])
        (data, dropped), qpos = jax.lax.scan(look, (data, jnp.array(False)), chunks)
        qpos = jnp.concatenate([state.qpos[None], qpos])
        looks = jax.vmap(lambda q: self.observation(eqx.tree_at(lambda s: s.qpos, state, q)))(qpos)
        return data.qpos, data.qvel, looks, dropped

    def observe(self, state: SimState) -> RopeState:
        """Link centres and gripper positions, world frame, metres."""
        return self.observation(state).rope

    def observation(self, state: SimState) -> Observation:
        """What `observe` gives, and the directions of the links and the points held."""
        model, data = self._load(state)
        data = mjx.kinematics(model, data)
        return read_observation(self.layout, model.geom_size, data.xpos, data.xmat, data.site_xpos)

    @eqx.filter_jit
    def observations(self, states: SimState) -> Observation:
        """`observation` of a batch."""
        return jax.vmap(self.observation)(states)

    def obstacles(self, state: SimState) -> Obstacles:
        """The primitives of the obstacles where they are."""
        return obstacles_at(self.scene, state.obstacle_position, state.obstacle_quaternion)

    def rollout(self, states: SimState, actions: Float[Array, "B T G 3"]) -> tuple[SimState, Trajectory]:
        """T control periods of B elements: the bulk path. Returns the last states and all that was seen.

        Outside of jit a CPU simulates large batches in parts, with all its processors.
        """
        if self.model.impl == mjx.Impl.JAX and worth_parts(PART, (states, actions), self):
            return in_parts(self._rollout, PART, states, actions)
        return self._rollout(states, actions)

    @eqx.filter_jit
    def _rollout(self, states: SimState, actions: Float[Array, "B T G 3"]) -> tuple[SimState, Trajectory]:
        return jax.vmap(self._rollout_one)(states, actions)

    def _rollout_one(self, state: SimState, actions: Float[Array, "T G 3"]) -> tuple[SimState, Trajectory]:
        def period(state, action):
            after, looks, near = self._step(state, action)
            ends = jax.tree.map(lambda leaf: leaf[jnp.array([0, -1])], looks)
            return after, (ends, near, after.faults)

        last, (ends, near, faults) = jax.lax.scan(period, state, actions)
        # of each period the state after it, and of the first the one before
        seen, near = jax.tree.map(lambda leaf: jnp.concatenate([leaf[0, :1], leaf[:, 1]]), (ends, near))
        trajectory = Trajectory(
            states=seen.rope,
            actions=actions,
            faults=faults,
            clearance=near,
            stretch=jax.vmap(lambda o: stretch(self.scene, state.holding, o))(seen),
        )
        return last, trajectory

    def _load(self, state: SimState) -> tuple[mjx.Model, mjx.Data]:
        model = self.model.replace(**state.model_fields)
        data = self.data.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            mocap_pos=state.obstacle_position,
            mocap_quat=state.obstacle_quaternion,
            eq_active=self.data.eq_active.at[self._hold_rows()].set(state.holding),
        )
        return model, data

    def _hold_rows(self):
        """The holds are the last equalities of a model."""
        return slice(self.data.eq_active.shape[0] - len(self.scene.grippers), None)

    def _contacts_dropped(self, data: mjx.Data) -> Bool[Array, ""]:
        if self.model.impl == mjx.Impl.WARP:
            from doojax.simulation.engines.warp import contacts_dropped

            return contacts_dropped(data)
        contact = data._impl.contact
        if contact.dist.shape[0] < self.scene.solver.max_contact_points:
            return jnp.array(False)
        return jnp.all(contact.dist < 0)
