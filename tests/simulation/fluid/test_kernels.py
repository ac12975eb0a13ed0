"""The kernel against quadrature, and what a wall cuts off of it against counting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.simulation.fluid.kernels import Kernel


def lattice(reach, dimensions, count=60):
    axis = (np.arange(-count, count) + 0.5) * reach / count
    return np.stack(np.meshgrid(*[axis] * dimensions, indexing="ij"), axis=-1), (reach / count) ** dimensions


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_kernel_has_mass_one(dimensions):
    kernel = Kernel(0.03, dimensions)
    points, cell = lattice(kernel.reach, dimensions)
    weight = kernel.value(np.linalg.norm(points, axis=-1), xp=np) * cell
    assert weight.sum() == pytest.approx(1, rel=1e-3)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_what_is_behind_a_plane_is_what_is_counted_there(dimensions):
    kernel = Kernel(0.03, dimensions)
    points, cell = lattice(kernel.reach, dimensions)
    weight = kernel.value(np.linalg.norm(points, axis=-1), xp=np) * cell
    edges = np.arange(61) * kernel.reach / 60  # where planes of the lattice's cells are
    counted = [weight[points[..., 0] > edge].sum() for edge in edges]
    found, slope = jax.vmap(kernel.behind)(jnp.asarray(edges, jnp.float32))
    np.testing.assert_allclose(found, counted, atol=1e-3)
    differences = np.gradient(np.asarray(found, np.float64), edges)
    np.testing.assert_allclose(slope[1:-1], differences[1:-1], atol=0.03 * np.abs(differences).max())
    assert float(kernel.behind(jnp.array(0.05))[0]) == 0


def test_slopes_are_derivatives():
    kernel = Kernel(0.03, 3)
    r = jnp.linspace(0.001, 0.031, 40)
    by_jax = jax.vmap(jax.grad(kernel.value))(r)
    np.testing.assert_allclose(kernel.slope(r) * r, by_jax, rtol=1e-4, atol=1e-3)
