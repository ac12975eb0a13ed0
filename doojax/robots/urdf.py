"""What a URDF file says of its joints that MuJoCo drops: speeds and forces at most."""

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

MOVING = ("revolute", "continuous", "prismatic")


class JointLimits(NamedTuple):
    """Of one joint; infinite where the file says nothing, or zero."""

    effort: float  # N m or N
    speed: float  # rad/s or m/s
    bounded: bool  # has it a range?
    turns: bool  # on and on, as continuous joints do, which need none


def urdf_limits(file: Path) -> dict[str, JointLimits] | None:
    """Limits by joint of a URDF file, in its order; None for another XML file.

    Raises:
        ValueError: it is no XML.
    """
    try:
        root = ElementTree.parse(file).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{file} is no XML that can be parsed: {error}") from error
    if root.tag != "robot":
        return None
    found = {}
    for joint in root.iter("joint"):
        if joint.get("type") not in MOVING:
            continue
        given = joint.find("limit")
        values = {} if given is None else given.attrib
        low, high = (float(values.get(name, 0)) for name in ("lower", "upper"))
        found[joint.get("name", "")] = JointLimits(
            _most(values.get("effort")),
            _most(values.get("velocity")),
            low < high,
            joint.get("type") == "continuous",
        )
    return found


def _most(text: str | None) -> float:
    value = float("inf") if text is None else float(text)
    return value if value > 0 else float("inf")
