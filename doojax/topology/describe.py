"""Scenes described in a file, and `doojax signature`, which prints the signature of one.

A description is a JSON object; lengths are in metres, points are [x, y, z], loops repeat their first point:

    {
      "skeleton": {"ring": [[0.5, -1, -1], [0.5, 1, -1], [0.5, 1, 1], [0.5, -1, 1], [0.5, -1, -1]]},
      "rope": [[0, 0, 0], [0.5, 0, 0], [1, 0, 0]],
      "base": [0, -2, 0],
      "grippers": {"right": {"location": 0.9, "path": [[1, -2, 0], [1, -0.1, 0]]}},
      "attachments": {"wall": {"location": 0, "path": []}}
    }

A location is a fraction of the rope. A path leads from the base, which it does not repeat, to the gripper or
attachment; it may be empty, and "attachments" may be left out.
"""

import sys
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from doojax.geometry.rounding import LostDigits
from doojax.reading import checked, parsed, read_text
from doojax.topology import grasp_loops
from doojax.topology.grasp_loops import Grasps, Holder, loops_of, make_grasps
from doojax.topology.linking import Points, check_points, linking_of
from doojax.topology.skeletons import Skeleton, make_skeleton

THREADING = Path(__file__).with_name("threading.json")
"""An example: a cable through three fixtures, plugged in at one end and held by two grippers."""

Point = tuple[float, float, float]
_FIELDS = {"skeleton", "rope", "base", "grippers", "attachments"}


class Scene(NamedTuple):
    """A described scene."""

    grasps: Grasps
    skeleton: Skeleton
    holders: tuple[str, ...]  # names of the grippers, then of the attachments
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What coordinates are counted from, metres: the described base, where that is so far away, as in map
    coordinates, that float32 would lose their digits."""


def read_scene(file: Path | str) -> Scene:
    """Read and check the description of a scene.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not JSON, or an item of it is missing, unknown or wrong; the message says which.
    """
    file = Path(file)
    try:
        content = parsed(read_text(file))
        content: dict[str, Any] = {"attachments": {}} | _fields_of(
            content, "the scene", _FIELDS, optional={"attachments"}
        )
        grippers, attachments = (
            {
                name: _holder(item, f"{kind} {name!r}")
                for name, item in _named(content[f"{kind}s"], kind).items()
            }
            for kind in ("gripper", "attachment")
        )
        loops = _named(content["skeleton"], "skeleton loop")
        loops = {name: checked(loop, list[Point], f"skeleton loop {name!r}") for name, loop in loops.items()}
        base = checked(content["base"], Point, "the base")
        parts = loops, checked(content["rope"], list[Point], "the rope"), base
        try:
            return _scene(*parts, grippers, attachments)
        except LostDigits:
            return _counted_from_the_base(*parts, grippers, attachments)
    except ValueError as error:
        raise ValueError(f"{file} does not describe a scene: {error}") from error


def _scene(
    loops: Mapping[str, Points],
    rope: Points,
    base: Points,
    grippers: Mapping[str, Holder],
    attachments: Mapping[str, Holder],
) -> Scene:
    skeleton, grasps = make_skeleton(loops), make_grasps(rope, base, grippers, attachments)
    return Scene(grasps, skeleton, (*grippers, *attachments))


def _counted_from_the_base(
    loops: Mapping[str, Points], rope: Points, base: Points, *holders: Mapping[str, Holder]
) -> Scene:
    """The scene, from which the base was subtracted while all was in double precision."""
    (origin,) = check_points(np.asarray(base)[None], "the base")

    def near(points: Points, name: str) -> Points:
        return check_points(points, name) - origin

    near_loops = {name: near(loop, f"skeleton loop {name!r}") for name, loop in loops.items()}
    near_holders = (
        {name: item._replace(path=near(item.path, f"the path of {name!r}")) for name, item in group.items()}
        for group in holders
    )
    scene = _scene(near_loops, near(rope, "the rope"), np.zeros(3), *near_holders)
    return scene._replace(origin=tuple(origin.tolist()))


def signature(file: Path, /, *, keep_empty: bool = False) -> None:
    """Print the grasp loop signature of the scene that a JSON file describes, and what it is made of.

    For each grasp loop follow its linking number, with sign, and its distance from each obstacle loop.

    Args:
        file: the description; its format is in docs/topology.md.
        keep_empty: keep loops between two grippers that are linked with nothing.

    Raises:
        ValueError: the file does not describe a scene, or a grasp loop touches an obstacle loop.
    """
    scene = read_scene(file)
    loops = jax.jit(loops_of)(scene.grasps)
    pairs = jax.jit(jax.vmap(jax.vmap(linking_of, (None, 0)), (0, None)))(loops.points, scene.skeleton.loops)
    lines = []
    for place in np.flatnonzero(loops.active):
        holders = " - ".join(scene.holders[end] for end in np.asarray(loops.holders[place]))
        lines.append(holders)
        for other, name in enumerate(scene.skeleton.names):
            margin = float(pairs.margin[place, other])
            if pairs.touching[place, other]:
                raise ValueError(
                    f"grasp loop {holders} and skeleton loop {name!r} touch: their least distance is "
                    f"{margin:.3g} m, so that their linking number is not defined"
                )
            number = int(pairs.number[place, other])
            lines.append(f"  {name}: {f'{number:+d}' if number else '0'}, {margin:.4f} m away")
    compute = jax.jit(grasp_loops.signature, static_argnames="remove_empty")
    text = str(compute(scene.grasps, scene.skeleton, remove_empty=not keep_empty))
    print(text.replace("∅", "{}") if _lacks(sys.stdout.encoding, "∅") else text)
    print(*(lines or ["no grasp loops"]), sep="\n")


def _lacks(encoding: str | None, letter: str) -> bool:
    try:
        letter.encode(encoding or "utf-8")
    except UnicodeEncodeError:
        return True
    return False


def _holder(item: Any, name: str) -> Holder:
    fields = _fields_of(item, name, {"location", "path"})
    location = checked(fields["location"], float, f"the location of {name}")
    return Holder(location, checked(fields["path"], list[Point], f"the path of {name}"))


def _named(items: Any, kind: str) -> Mapping[str, Any]:
    if not isinstance(items, dict):
        raise ValueError(f"the {kind}s are {items!r}; expected an object with a name for each")
    return items


def _fields_of(item: Any, name: str, fields: Set[str], optional: Set[str] = frozenset()) -> dict[str, Any]:
    """The item, if it is an object with these fields, of which the optional ones may lack, and no other."""
    if not isinstance(item, dict):
        raise ValueError(f"{name} is {item!r}; expected an object")
    for wrong, problem in ((fields - optional - set(item), "lacks"), (set(item) - fields, "has unknown")):
        if wrong:
            raise ValueError(f"{name} {problem} {', '.join(sorted(wrong))}")
    return item
