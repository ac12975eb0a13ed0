"""Distances of segments beside those of many points along each."""

import jax
import jax.numpy as jnp
import numpy as np

from doojax.geometry import segment_distance


def test_segments_are_as_far_apart_as_their_nearest_points():
    rng = np.random.default_rng(0)
    ends = rng.normal(size=(4, 101, 3)).astype(np.float32)
    ends[1, :20] = ends[0, :20]  # points
    ends[3, 20:40] = ends[2, 20:40] + 0.7 * (ends[1, 20:40] - ends[0, 20:40])  # parallel ones
    ends[2, 100] = ends[0, 100]  # a common end
    found, slope = jax.jit(jax.value_and_grad(lambda e: segment_distance(*e).sum()))(jnp.asarray(ends))
    assert jnp.isfinite(slope).all() and jnp.isfinite(found)
    found = np.asarray(jax.jit(segment_distance)(*ends))
    t = np.linspace(0, 1, 301)[:, None]
    for i in range(101):
        first, second = (a[i] + t * (b[i] - a[i]) for a, b in (ends[:2], ends[2:]))
        sampled = np.linalg.norm(first[:, None] - second[None], axis=-1).min()
        assert sampled - 0.02 < found[i] <= sampled + 1e-5
    assert found[100] == 0
