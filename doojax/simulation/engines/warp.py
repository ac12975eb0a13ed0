"""What MJX's NVIDIA implementation (MuJoCo Warp) needs beyond MJX: room for contacts, made in advance.

Its contacts lie in one array for the whole batch, so that array's size depends on how many elements there
are, which a pure function of one element does not know until it is vmapped. `for_any_batch` finds out.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool

from doojax.simulation.build import build_model
from doojax.simulation.engines.quiet_mjx import mjx
from doojax.simulation.scenes import Scene
from doojax.types import ShapeKind

ROWS = {
    mujoco.mjtEq.mjEQ_CONNECT.value: 3,
    mujoco.mjtEq.mjEQ_WELD.value: 6,
    mujoco.mjtEq.mjEQ_TENDON.value: 1,
}
ROWS_OF_CONTACT = 4  # of a friction pyramid with three dimensions
DROPPED = 0b11111  # overflow bits: constraint rows, their non-zeros, near pairs, contacts, convex pairs


def warp_model(model: mujoco.MjModel) -> mjx.Model:
    """``model`` for MuJoCo Warp, which reports overflow as data and prints nothing."""
    # Warp never resets a state by itself, and refuses the flag that asks for just that
    before = model.opt.disableflags
    model.opt.disableflags = before & ~mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    made = mjx.put_model(model, impl="warp")
    model.opt.disableflags = before
    return made.tree_replace({"opt._impl.warn_overflow": 0})


def warp_data(scene: Scene, batch: int) -> mjx.Data:
    """A fresh state of one element, with room for the contacts of ``batch`` elements together.

    An element's share is twice as many contacts as MJX keeps, which its near pairs need, too; an element with
    more may use what others leave. Constraint rows are an element's own.
    """
    model = build_model(scene)
    settings = scene.solver
    contacts = 2 * batch * settings.max_contact_points
    # only cylinders meet a rope by the general convex algorithm, whose scratch space is large
    convex = any(shape.kind == ShapeKind.CYLINDER for body in scene.obstacles for shape in body.shapes)
    with jax.ensure_compile_time_eval():
        made = mjx.make_data(
            model,
            impl="warp",
            naconmax=contacts,
            naccdmax=contacts if convex else 1,
            njmax=sum(ROWS[kind] for kind in model.eq_type) + ROWS_OF_CONTACT * settings.max_contact_points,
        )
        made = jax.tree.map(np.asarray, made)
    return jax.tree.map(_without_copies, made)


def contacts_dropped(data: mjx.Data) -> Bool[Array, ""]:
    """Did the last step of this element run out of room?"""
    return (data._impl.overflow & DROPPED).any()


def for_any_batch[S: eqx.Module](
    simulator: S, method: Callable[..., Any], with_room: Callable[[S, int], S]
) -> Callable[..., Any]:
    """``method(simulator, ...)`` of one element, that under `jax.vmap` gets room for the whole batch.

    The room is for the innermost vmap; an outer one has to make do with it and reports what does not fit.
    ``with_room(simulator, batch)`` is the simulator that has it.
    """
    arrays, static = eqx.partition(simulator, eqx.is_array)

    @jax.custom_batching.custom_vmap
    def one(arrays, *arguments):
        return method(eqx.combine(arrays, static), *arguments)

    @one.def_vmap
    def many(batch, is_batched, arrays, *arguments):
        own = with_room(eqx.combine(arrays, static), batch)
        axes = jax.tree.map(lambda batched: 0 if batched else None, tuple(is_batched[1:]))
        out = jax.vmap(lambda *each: method(own, *each), axes)(*arguments)
        return out, jax.tree.map(lambda _: True, out)

    return lambda *arguments: one(arrays, *arguments)


def _without_copies(values: np.ndarray) -> Array:
    """An array that a compiled program makes instead of holding it, where all its values are the same."""
    if values.size > 1 and (values == values.flat[0]).all():
        return jnp.full(values.shape, values.flat[0], values.dtype)
    return jnp.asarray(values)
