"""Which transforms are valid, tried out in the simulator: the thesis's Algorithm 3.

A limp rope that is laid on its side falls; a stiff one may not. Validity is of the transform alone, so it is
tried where nothing is in the way: several examples for each transform, of which the least error counts, since
one that met the floor says nothing of the transform.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doojax.augmentation.examples import Bounds
from doojax.augmentation.resimulation import drawn_examples, resimulation_errors
from doojax.augmentation.settings import setting_of
from doojax.keys import numbered, stream
from doojax.simulation.state import Simulator
from doojax.tasks.base import Task

EXAMPLES = 5  # for each transform
AT_ONCE = 64  # transforms: a batch of five times as many simulations


class TransformErrors(NamedTuple):
    """What was tried."""

    transforms: Float[np.ndarray, "N 6"]  # translation (m), rotation vector (rad), about an example's centre
    errors: Float[np.ndarray, "N"]  # m, root mean square over the points; the least of `EXAMPLES`


def usual_count(bounds: Bounds) -> int:
    """How many transforms the thesis tries, 10^(d/2) of d dimensions: 31 in a plane, 1,000 in space."""
    return int(10 ** (np.count_nonzero(np.asarray(bounds.array)) / 2))


def transform_errors(
    task: Task, simulator: Simulator, bounds: Bounds, count: int, seed: int
) -> TransformErrors:
    """Try ``count`` transforms, the later ones larger, and simulate what becomes of examples moved so.

    Args:
        task: without obstacles in the way, as its phase unconstrained.
        simulator: of the task.
        bounds: of the largest transforms.
        count: of transforms, at least 1.
        seed: of transforms and examples.
    """
    setting = setting_of(task, bounds)
    share = jnp.arange(1, count + 1, dtype=jnp.float32)[:, None] / count
    keys = numbered(stream(seed, "validity", "transforms"), range(count))
    unit = jax.vmap(lambda key: jax.random.uniform(key, (6,), minval=-1.0, maxval=1.0))(keys)
    transforms = share * unit * setting.bounds
    start_key, action_key = (stream(seed, "validity", name) for name in ("starts", "actions"))
    starts, examples = drawn_examples(task, simulator, EXAMPLES, start_key, action_key)
    errors = []
    for some in np.split(np.asarray(transforms), range(AT_ONCE, count, AT_ONCE)):
        again = _repeated((starts, examples), len(some))
        tried = jnp.repeat(jnp.asarray(some), EXAMPLES, axis=0)
        found = resimulation_errors(task, simulator, setting, *again, tried)
        errors.append(found.reshape(-1, EXAMPLES).min(1))
    return TransformErrors(np.asarray(transforms), np.concatenate(errors))


def _repeated[T](batch: T, times: int) -> T:
    """All elements, and all again."""
    return jax.tree.map(lambda leaf: jnp.tile(leaf, (times, *[1] * (leaf.ndim - 1))), batch)
