"""From two trees that met to a motion: the way through them, without detours, checked once more."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from doojax.planning.joint_lines import MOST_PLACES, Line, Outcome, line_to
from doojax.planning.joint_tree import JointSearch

BEYOND_DRAWS = 2_000_000  # numbers of the key that no search uses


class JointPath(eqx.Module):
    """A way that is being shortened, then checked."""

    points: Float[Array, "*b W M"]
    count: Int[Array, "*b"]  # of points; after the last they repeat it
    line: Line  # that is being checked
    first: Int[Array, "*b"]  # the points that it joins
    last: Int[Array, "*b"]
    tried: Int[Array, "*b"]  # lines so far
    shortcuts: Int[Array, "*b"]  # that are tried before the way is checked
    keeps: Float[Array, "*b"]  # m, of shortcuts; what is left need keep none
    whole: Bool[Array, "*b"]  # nothing that was checked is in the way
    ended: Bool[Array, "*b"]

    @property
    def going(self) -> Bool[Array, "*b"]:
        """Whether there is more to check."""
        return ~self.ended

    @property
    def margin(self) -> Float[Array, "*b"]:
        """What the line's places must keep, m."""
        return jnp.where(self.tried <= self.shortcuts, self.keeps, 0.0)


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
        keeps=jnp.full((), margin, points.dtype),
        whole=fits,
        ended=~fits,
    )
    nothing = Outcome(zero, jnp.array(True), jnp.array(False))  # so that a line is begun
    return shortened(path, nothing, step, key)


def shortened(path: JointPath, outcome: Outcome, step: float, key: Key[Array, ""]) -> JointPath:
    """The way after some places of its line were asked.

    First lines between two points drawn, which leave out what is between them where they are free; then all
    lines that are left, one after another, with places half as far apart. Two points that are so far apart
    that a line has too few places are joined by no shortcut.
    """
    going, place = path.going, jnp.arange(len(path.points))
    tries = (path.tried > 0) & (path.tried <= path.shortcuts)
    passed, failed = outcome.passed & going, outcome.failed & going
    skipped = jnp.where(passed & tries, path.last - path.first - 1, 0)
    points = path.points[
        jnp.where(place > path.first, jnp.minimum(place + skipped, len(path.points) - 1), place)
    ]
    count = path.count - skipped
    checked = path.tried > path.shortcuts

    ended = passed | failed
    # when there is nothing to leave out, all shortcuts count as tried
    tried = jnp.where(count > 2, path.tried + 1, jnp.maximum(path.tried + 1, path.shortcuts + 1))
    one, two = jax.random.uniform(jax.random.fold_in(key, BEYOND_DRAWS + path.tried), (2,))
    begin = jnp.floor(one * (count - 2)).astype(int)
    end = begin + 2 + jnp.floor(two * (count - 2 - begin)).astype(int)
    checks = tried > path.shortcuts
    following = jnp.where(checked, path.first + 1, 0)
    first = jnp.clip(jnp.where(checks, following, begin), 0, jnp.maximum(count - 2, 0))
    last = jnp.minimum(jnp.where(checks, first + 1, end), count - 1)
    over = checked & ((following >= count - 1) | failed)
    far = ~checks & (jnp.max(jnp.abs(points[last] - points[first])) > step * MOST_PLACES)
    last = jnp.where(far, first + 1, last)  # nothing is left out
    line = line_to(points[first], points[jnp.where(far, first, last)], jnp.where(checks, step / 2, step))

    on = eqx.tree_at(lambda one: one.asked, path.line, path.line.asked + jnp.where(going, outcome.asked, 0))
    after = line, first, last, tried
    before = on, path.first, path.last, path.tried
    return eqx.tree_at(
        lambda p: (p.points, p.count, p.whole, p.ended, p.line, p.first, p.last, p.tried),
        path,
        (
            points,
            count,
            path.whole & ~(checked & failed),
            path.ended | (ended & over),
            *jax.tree.map(lambda new, old: jnp.where(ended & ~over, new, old), after, before),
        ),
    )
