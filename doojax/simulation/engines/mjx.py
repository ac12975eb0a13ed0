"""MuJoCo MJX: pure functions that jit, vmap, scan and differentiate, on any device that JAX knows."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.modules import Jittable
from doojax.parts import in_parts, worth_parts
from doojax.simulation.build import build_model
from doojax.simulation.engines.implicit import step
from doojax.simulation.engines.quiet_mjx import mjx
from doojax.simulation.layout import (
    Layout,
    Observation,
    look_every,
    observe,
    read_frames,
    stretch,
    watch,
)
from doojax.simulation.scenes import Scene, obstacles_at
from doojax.simulation.state import Fault, SimState, Start, find_faults
from doojax.types import Obstacles, Trajectory

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
            data = mjx.make_data(model, impl="jax")
            if not (np.asarray(data._impl.contact.dim) > 1).any():
                # where nothing can touch, cones make no difference, and MJX's elliptic ones fail
                model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
            made = mjx.put_model(model, impl="jax"), data
        # not committed to the device, unlike what MJX gives, lest states on other devices do not fit them
        self.model, self.data = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), made)

    def reset(self, key: Array) -> SimState:
        """A start drawn from the task's distribution."""
        return self.start(key)

    def step(self, state: SimState, action: Float[Array, "*action"]) -> SimState:
        """One control period: move each hand by ``action`` [G, 3] (m, world axes), at bounded speed."""
        return self._step(state, action)[0]

    def _step(
        self, state: SimState, action: Float[Array, "*action"]
    ) -> tuple[SimState, Observation, Float[Array, "2"]]:
        """`step`, the K looks on the way, and `clearance` (m) before it and the least in it."""
        driven = state.qpos[self.layout.driven]
        controls, commanded = self.scene.driver.drive(self.scene, driven, state.commanded, action)
        advance = MjxSimulator._advance
        if self.model.impl == mjx.Impl.WARP:
            from doojax.simulation.engines.warp import for_any_batch

            qpos, qvel, looks, dropped = for_any_batch(self, advance, _with_room)(state, controls)
        else:
            qpos, qvel, looks, dropped = advance(self, state, controls)
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
            (qpos, qvel, commanded.astype(state.commanded.dtype), faults.astype(jnp.int32)),
        )
        return after, looks, near

    def _advance(
        self, state: SimState, controls: Float[Array, "S U"]
    ) -> tuple[Array, Array, Observation, Bool[Array, ""]]:
        """One physics step for each control: positions, velocities, looks on the way, contacts dropped?"""
        model, data = self._load(state)

        def substep(carry, control):
            before, dropped = carry
            data = step(model, before.replace(ctrl=control))
            # with 64-bit floats enabled, MJX also widens the indices of tendons
            data = jax.tree.map(lambda new, old: new.astype(old.dtype), data, before)
            return (data, dropped | self._contacts_dropped(data)), None

        def look(carry, controls):
            (data, dropped), _ = jax.lax.scan(substep, carry, controls)
            return (data, dropped), (data.qpos, data.qvel)

        chunks = controls.reshape(-1, look_every(self.scene), controls.shape[-1])
        (data, dropped), way = jax.lax.scan(look, (data, jnp.array(False)), chunks)
        way = jax.tree.map(lambda now, on: jnp.concatenate([now[None], on]), (state.qpos, state.qvel), way)
        at = jax.vmap(lambda qpos, qvel: eqx.tree_at(lambda s: (s.qpos, s.qvel), state, (qpos, qvel)))(*way)
        looks = jax.vmap(self.observation)(at)
        return data.qpos, data.qvel, looks, dropped

    def observe(self, state: SimState) -> Any:
        """What learners and planners see, such as a `doojax.types.RopeState`."""
        return self.observation(state).state

    def observation(self, state: SimState) -> Observation:
        """What `observe` gives, and a rope's shape."""
        model, data = self._load(state)
        data = mjx.kinematics(model, data)
        layout = self.layout
        vectors = read_frames(self.scene, layout, data.xpos, data.xmat, data.site_xpos)
        coordinates = jnp.concatenate([state.qpos, state.qvel])[layout.coordinates]
        return observe(self.scene, layout, vectors, coordinates, model.geom_size[layout.sizes, :2])

    @eqx.filter_jit
    def observations(self, states: SimState) -> Observation:
        """`observation` of a batch."""
        return jax.vmap(self.observation)(states)

    def obstacles(self, state: SimState) -> Obstacles:
        """The primitives of the obstacles where they are."""
        return obstacles_at(self.scene, state.obstacle_position, state.obstacle_quaternion)

    def rollout(self, states: SimState, actions: Float[Array, "B T *action"]) -> tuple[SimState, Trajectory]:
        """T control periods of B elements: the bulk path. Returns the last states and all that was seen.

        Outside of jit a CPU simulates large batches in parts, with all its processors.
        """
        if self.model.impl == mjx.Impl.JAX and worth_parts(PART, (states, actions), self):
            return in_parts(self._rollout, PART, states, actions)
        return self._rollout(states, actions)

    @eqx.filter_jit
    def _rollout(self, states: SimState, actions: Float[Array, "B T *action"]) -> tuple[SimState, Trajectory]:
        return jax.vmap(self._rollout_one)(states, actions)

    def _rollout_one(
        self, state: SimState, actions: Float[Array, "T *action"]
    ) -> tuple[SimState, Trajectory]:
        def period(state, action):
            after, looks, near = self._step(state, action)
            ends = jax.tree.map(lambda leaf: leaf[jnp.array([0, -1])], looks)
            return after, (ends, near, after.faults)

        last, (ends, near, faults) = jax.lax.scan(period, state, actions)
        # of each period the state after it, and of the first the one before
        seen, near = jax.tree.map(lambda leaf: jnp.concatenate([leaf[0, :1], leaf[:, 1]]), (ends, near))
        trajectory = Trajectory(
            states=seen.state,
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
            eq_active=self.data.eq_active.at[self.layout.holds].set(state.holding),
        )
        return model, data

    def _contacts_dropped(self, data: mjx.Data) -> Bool[Array, ""]:
        if self.model.impl == mjx.Impl.WARP:
            from doojax.simulation.engines.warp import contacts_dropped

            return contacts_dropped(data)
        contact = data._impl.contact
        if contact.dist.shape[0] < self.scene.solver.max_contact_points:
            return jnp.array(False)
        return jnp.all(contact.dist < 0)


def _with_room(simulator: MjxSimulator, batch: int) -> MjxSimulator:
    """With a fresh state that has room for the contacts of ``batch`` elements."""
    from doojax.simulation.engines.warp import warp_data

    return eqx.tree_at(lambda s: s.data, simulator, warp_data(simulator.scene, batch))
