"""Ways of a point past discs: called free where they are everywhere, beside the distance in closed form."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from doojax.planning.joint_lines import walked
from doojax.planning.joint_sweep import LEAST, sweep, swept

QUERIES, AT_ONCE = 400, 3
RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform(0, 1, (QUERIES, 4, 2)).astype(np.float32)
COUNTS = RANDOM.integers(1, 5, QUERIES)
CENTRES = RANDOM.uniform(0, 1, (QUERIES, 2)).astype(np.float32)
RADII = np.exp(RANDOM.uniform(np.log(1e-4), np.log(0.3), QUERIES)).astype(np.float32)
PINS = slice(0, 40)  # thin, and on the first line
CENTRES[PINS] = POINTS[PINS, 0] + RANDOM.uniform(0, 1, (40, 1)) * (POINTS[PINS, 1] - POINTS[PINS, 0])
RADII[PINS] = 1e-4


def gap(points, centre, radius):
    """Of a way from a disc, m; the nearest place of each line is where its perpendicular meets it."""
    begins, lines = points[:-1], np.diff(points, axis=0)
    along = ((centre - begins) * lines).sum(-1) / (lines**2).sum(-1)
    nearest = begins + np.clip(along, 0, 1)[:, None] * lines
    return np.linalg.norm(nearest - centre, axis=-1).min() - radius


@jax.jit
def is_swept(points, counts):
    def free(values, query, margin):
        away = jnp.linalg.norm(values - jnp.asarray(CENTRES)[query], axis=-1)
        return away > jnp.asarray(RADII)[query] + margin[:, 0]

    travels = jnp.linalg.norm(points[:, 1:] - points[:, :-1], axis=-1, keepdims=True)
    begun = jax.vmap(sweep)(points, counts, travels, jnp.ones(len(points), bool))
    return walked(begun, free, lambda own, outcome, _: swept(own, outcome, AT_ONCE), 16, AT_ONCE).free


def test_a_way_is_free_where_no_disc_is_met_and_no_pin_between_places():
    places = np.arange(4)[None, :, None] < COUNTS[:, None, None]
    points = np.where(places, POINTS, np.take_along_axis(POINTS, COUNTS[:, None, None] - 1, 1))
    found = np.asarray(is_swept(jnp.asarray(points), jnp.asarray(COUNTS)))
    ways = [own[: max(count, 2)] for own, count in zip(POINTS, COUNTS, strict=True)]
    gaps = np.array(list(map(partial(gap), ways, CENTRES, RADII)))
    moves = COUNTS > 1
    assert not found[moves & (gaps < 0)].any() and found[moves & (gaps > 2 * LEAST)].all()
    assert (gaps[PINS][moves[PINS]] < 0).all() and moves[PINS].sum() > 20
    assert found[moves].mean() > 0.5 and (gaps[moves] < 0).mean() > 0.1
