"""A step of MJX whose derivatives hold at rest, in contact and through the solver's loop.

What MJX's own step would differentiate is the path that the solver took. That path is no function to trust:
where the solver has nothing left to do, as at rest, it takes no step, and the forces have no derivative at
all; reverse mode cannot cross its loop; and friction's cones divide by how fast they slide. The solution
itself is smooth almost everywhere: accelerations x at which a residual r(x, data) vanishes change by
dx = -(dr/dx)^-1 dr. The residual is the gradient of MuJoCo's cost: its documentation, chapter Computation.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from doojax.simulation.engines.quiet_mjx import mjx


def step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.step` without sensors; with other integrators than Euler's, and on warp, it is MJX's own."""
    if model.impl == mjx.Impl.WARP or model.opt.integrator != mjx.IntegratorType.EULER:
        return mjx.step(model, data)
    data = mjx.fwd_acceleration(
        model, mjx.fwd_actuation(model, mjx.fwd_velocity(model, mjx.fwd_position(model, data)))
    )
    constrained = data._impl.efc_J.size > 0
    qacc = _acceleration(model, data) if constrained else data.qacc_smooth
    return mjx.euler(model, data.replace(qacc=qacc))


@jax.custom_jvp
def _acceleration(model: mjx.Model, data: mjx.Data) -> Float[Array, "V"]:
    return mjx.solve(model, data).qacc


@_acceleration.defjvp
def _acceleration_jvp(primals, tangents):
    qacc = _acceleration(*primals)
    slope = jax.jacfwd(lambda x: _residual(x, *primals))(qacc)
    change = jax.jvp(lambda model, data: _residual(qacc, model, data), primals, tangents)[1]
    factor = jax.scipy.linalg.cho_factor((slope + slope.T) / 2)
    return qacc, -jax.scipy.linalg.cho_solve(factor, change)


def _residual(qacc: Float[Array, "V"], model: mjx.Model, data: mjx.Data) -> Float[Array, "V"]:
    """What the generalised forces lack to be those that accelerate by ``qacc``: zero at the solution."""
    rows = data._impl
    force = _forces(rows.efc_J @ qacc - rows.efc_aref, model, data)
    return mjx.mul_m(model, data, qacc) - data.qfrc_smooth - rows.efc_J.T @ force


def _forces(gap: Float[Array, "R"], model: mjx.Model, data: mjx.Data) -> Float[Array, "R"]:
    """The force of each row of constraints, of how far it is from the acceleration that it asks for."""
    rows = data._impl
    linear = -rows.efc_D * gap
    equalities, friction = rows.ne, rows.ne + rows.nf
    least = jnp.concatenate(
        [
            jnp.full(equalities, -jnp.inf, gap.dtype),
            -rows.efc_frictionloss[equalities:friction],
            jnp.zeros(len(gap) - friction, gap.dtype),
        ]
    )
    most = jnp.full_like(gap, jnp.inf).at[equalities:friction].set(rows.efc_frictionloss[equalities:friction])
    force = jnp.clip(linear, least, most)
    sizes = np.asarray(rows.contact.dim)
    if model.opt.cone != mjx.ConeType.ELLIPTIC:
        return force
    for size in np.unique(sizes[sizes > 1]):
        at = np.asarray(rows.contact.efc_address)[sizes == size][:, None] + np.arange(size)
        slide = rows.contact.friction[sizes == size, : size - 1]
        ratio = slide[:, 0] / jnp.sqrt(model.opt.impratio)
        force = force.at[at].set(jax.vmap(_cone)(gap[at], linear[at], rows.efc_D[at[:, 0]], slide, ratio))
    return force


def _cone(
    gap: Float[Array, "K"],
    linear: Float[Array, "K"],
    stiffness: Float[Array, ""],
    friction: Float[Array, "K-1"],
    ratio: Float[Array, ""],
) -> Float[Array, "K"]:
    """An elliptic cone's force: that of springs where they stay within it, none where nothing presses, else
    what lies on the cone."""
    across = gap[1:] * friction
    square = (across**2).sum()
    still = square < mujoco.mjMINVAL**2
    slide = jnp.where(still, 0.0, jnp.sqrt(jnp.where(still, 1.0, square)))
    normal = gap[0] * ratio
    sticks = ratio * normal + slide <= 0
    free = normal >= ratio * slide
    push = stiffness / (ratio * (1 + ratio**2)) * (ratio * slide - normal)
    along = -push * friction * across / jnp.where(still, 1.0, slide)
    slips = jnp.concatenate([push[None], along])
    return jnp.where(sticks & (normal < 0), linear, jnp.where(free, 0.0, slips))
