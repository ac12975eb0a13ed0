"""From two trees that met to a motion: the way through them, without detours."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from doojax.planning.joint_lines import MOST_PLACES, Line, Outcome, line_to
from doojax.planning.joint_tree import JointSearch

BEYOND_DRAWS = 2_000_000  # numbers of the key that no search uses


class JointPath(eqx.Module):
    """A way that is being shortened."""

    points: Float[Array, "*b W M"]
    count: Int[Array, "*b"]  # of points; after the last they repeat it
    line: Line  # that may leave out what is between its ends
    first: Int[Array, "*b"]  # the points that it joins
    last: Int[Array, "*b"]
    tried: Int[Array, "*b"]  # lines so far
    shortcuts: Int[Array, "*b"]  # that are tried
    margin: Float[Array, "*b"]  # m, that they keep
    whole: Bool[Array, "*b"]  # there is a way at all
    ended: Bool[Array, "*b"]

    @property
    def going(self) -> Bool[Array, "*b"]:
        """Whether there is more to try."""
        return ~self.ended


def way(
    search: JointSearch, most: int, shortcuts: int, margin: float, step: float, key: Key[Array, ""]
) -> JointPath:
    """The nodes from the start to a goal; none if trees did not meet, or it takes more than ``most``."""

    def climb(tree: int) -> tuple[Array, Array]:
        def up(node: Array, _: None) -> tuple[Array, Array]:
            return jnp.where(node >= 0, search.parents[tree, node], -1), node

        _, nodes = jax.lax.scan(up, search.met[tree], None, most)
        return nodes, (nodes >= 0).sum()

    (back, begun), (on, ended) = climb(0), climb(1)
    place = jnp.arange(most)
    count = begun + ended - 1  # the node where they met is in both
    first = search.joints[0, back[jnp.clip(begun - 1 - place, 0, most - 1)]]
    second = search.joints[1, on[jnp.clip(jnp.minimum(place, count - 1) - begun + 1, 0, most - 1)]]
    points = jnp.where((place < begun)[:, None], first, second)
    fits = (search.met[0] >= 0) & (begun < most) & (ended < most) & (count <= most)
    zero = jnp.zeros((), int)
    path = JointPath(
        points=points,
        count=jnp.maximum(count, 1),
        line=line_to(points[0], points[0], step),
        first=zero,
        last=zero,
        tried=zero,
        shortcuts=zero + shortcuts,
        margin=jnp.full((), margin, points.dtype),
        whole=fits,
        ended=~fits,
    )
    nothing = Outcome(zero, zero, jnp.array(True), jnp.array(False))  # so that a line is begun
    return shortened(path, nothing, step, key)


def shortened(path: JointPath, outcome: Outcome, step: float, key: Key[Array, ""]) -> JointPath:
    """The way after some places of its line were asked.

    Lines between two points drawn leave out what is between them where they are free. Two points that are so
    far apart that a line has too few places are joined by none.
    """
    place = jnp.arange(len(path.points))
    passed, failed = outcome.passed & path.going, outcome.failed & path.going
    skipped = jnp.where(passed & (path.tried > 0), path.last - path.first - 1, 0)
    points = path.points[
        jnp.where(place > path.first, jnp.minimum(place + skipped, len(path.points) - 1), place)
    ]
    count = path.count - skipped

    ended, tried = passed | failed, path.tried + 1
    over = (tried > path.shortcuts) | (count <= 2)
    one, two = jax.random.uniform(jax.random.fold_in(key, BEYOND_DRAWS + path.tried), (2,))
    first = jnp.maximum(jnp.floor(one * (count - 2)).astype(int), 0)
    last = jnp.minimum(first + 2 + jnp.floor(two * (count - 2 - first)).astype(int), count - 1)
    far = jnp.max(jnp.abs(points[last] - points[first])) > step * MOST_PLACES
    last = jnp.where(far, first + 1, last)  # nothing is left out
    line = line_to(points[first], points[jnp.where(far, first, last)], step)

    asked = path.line.asked + jnp.where(path.going, outcome.asked, 0)
    before = eqx.tree_at(lambda one: one.asked, path.line, asked), path.first, path.last, path.tried
    return eqx.tree_at(
        lambda p: (p.points, p.count, p.ended, p.line, p.first, p.last, p.tried),
        path,
        (
            points,
            count,
            path.ended | (ended & over),
            *jax.tree.map(
                lambda new, old: jnp.where(ended & ~over, new, old), (line, first, last, tried), before
            ),
        ),
    )
