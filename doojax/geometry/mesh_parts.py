"""Is a mesh the surface of something solid? If so its parts, all wound outward; if not, what helps.

A part is what hangs together by edges. Parts may overlap, as do a post and the shelf that it stands through,
and lie within one another: wound as what it lies in, a part is one more solid; wound the other way, a cavity.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    from trimesh import Trimesh
else:
    Trimesh = Any  # trimesh is not loaded before a mesh exists

_PAIRS_AT_ONCE = 1_000_000


def solid_parts(mesh: Trimesh) -> list[Float[np.ndarray, "_ 3 3"]]:
    """The triangles of each solid part of a mesh, with those of its cavities; metres, double precision.

    All are wound outward, cavities towards their inside. A part that lies in no other counts as a solid,
    whichever way it is wound.

    Raises:
        ValueError: it is no `trimesh.Trimesh`, has no faces or coordinates that are not finite, is not
            watertight, is wound inconsistently, or has faces that lie back to back. The message says what
            mends it, if something was found that does.
    """
    check_is_mesh(mesh)
    complaint = _complaint(mesh)
    if complaint:
        raise ValueError(f"{complaint}; {_advice(mesh)}")
    triangles = np.asarray(mesh.triangles, float)
    parts = [triangles[faces] for faces in _connected(mesh)]
    volumes = [_volume(part) for part in parts]
    by_size = sorted(range(len(parts)), key=lambda place: -abs(volumes[place]))
    low, high = (np.array([end(part, axis=(0, 1)) for part in parts]) for end in (np.min, np.max))
    around: dict[int, list[int]] = {}  # what each part lies in, the smallest last
    for order, place in enumerate(by_size):
        larger = np.array(by_size[:order], int)
        near = larger[((low[larger] <= low[place]) & (high[larger] >= high[place])).all(axis=1)].tolist()
        around[place] = [other for other in near if _is_within(parts[place], parts[other])]

    solids: dict[int, list[np.ndarray]] = {}
    for place in by_size:
        outermost = around[place][0] if around[place] else place
        if volumes[outermost] < 0:
            parts[place] = parts[place][:, ::-1]
        homes = [other for other in around[place] if other in solids]
        if homes and (volumes[place] < 0) != (volumes[outermost] < 0):
            solids[homes[-1]].append(parts[place])
        else:
            solids[place] = [parts[place]]
    return [np.concatenate(solid) for solid in solids.values()]


def check_is_mesh(mesh: Any) -> None:
    """Refuse what is no mesh.

    Raises:
        ValueError: it is no `trimesh.Trimesh`, has no faces, or has coordinates that are not finite.
    """
    from trimesh import Scene, Trimesh

    if isinstance(mesh, Scene):
        raise ValueError(
            "expected a trimesh.Trimesh, got a trimesh.Scene: make one mesh of all that it shows, in place, "
            "with scene.to_mesh()"
        )
    if not isinstance(mesh, Trimesh):
        raise ValueError(f"expected a trimesh.Trimesh, got a {type(mesh).__name__}")
    if not len(mesh.faces):
        raise ValueError("the mesh has no faces, so it has no inside")
    finite = np.isfinite(mesh.vertices).all(axis=1)
    if not finite.all():
        raise ValueError(f"the mesh's vertex {np.argmin(finite)} is not finite: {mesh.vertices[~finite][0]}")


def _complaint(mesh: Trimesh) -> str | None:
    """What is wrong with a mesh."""
    pairs = _back_to_back(mesh)
    if pairs:
        return (
            f"{pairs} of the mesh's {len(mesh.faces)} faces lie back to back on another of the same part, as "
            "trimesh.repair.fill_holes makes them of split vertices, so that there is nothing between them"
        )
    if not mesh.is_watertight:
        edges = np.sort(mesh.edges, axis=1)
        _, uses = np.unique(edges, axis=0, return_counts=True)
        return (
            f"the mesh is not watertight: {np.count_nonzero(uses != 2)} of its {len(uses)} edges do not join "
            "two faces, so it has no inside"
        )
    if not mesh.is_winding_consistent:
        return "the mesh's faces are wound inconsistently, some outward and some inward"
    return None


def _back_to_back(mesh: Trimesh) -> int:
    """How many faces have the corners of another one of their part, in the other order."""
    faces = np.asarray(mesh.faces)
    turns = np.argmin(faces, axis=1)[:, None]
    turned = np.take_along_axis(faces, (turns + np.arange(3)) % 3, axis=1)  # smallest first, same winding
    known = {tuple(face) for face in turned.tolist()}
    return sum((a, c, b) in known for a, b, c in turned.tolist() if len({a, b, c}) == 3)


def _advice(mesh: Trimesh) -> str:
    """What makes a mesh sound: tried on a copy, not guessed."""
    import trimesh

    merge = "merge_vertices(merge_tex=True, merge_norm=True)"

    def merged(mesh: Trimesh) -> None:
        mesh.merge_vertices(merge_tex=True, merge_norm=True)

    steps: dict[str, Callable[[Any], Any]] = {
        f"join its split vertices with mesh.{merge}": merged,
        "turn its faces with trimesh.repair.fix_winding(mesh)": trimesh.repair.fix_winding,
        "drop doubled faces with mesh.update_faces(mesh.unique_faces())": lambda mesh: mesh.update_faces(
            mesh.unique_faces()
        ),
        "close its small holes with trimesh.repair.fill_holes(mesh)": trimesh.repair.fill_holes,
    }
    join, turn, drop, fill = steps
    for plan in (
        [join],
        [turn],
        [drop],
        [join, turn],
        [drop, join],
        [drop, join, turn],
        [fill],
        [join, fill],
    ):
        mended = mesh.copy()
        for step in plan:
            steps[step](mended)
        if not _complaint(mended):
            return ", then ".join(plan)
    return (
        "neither merging vertices, turning or dropping faces nor filling holes by trimesh mends it: close it "
        "where it was made"
    )


def _connected(mesh: Trimesh) -> list[Int[np.ndarray, "_"]]:
    """The faces of each part."""
    from trimesh.graph import connected_components

    faces = np.arange(len(mesh.faces))
    return [np.asarray(part) for part in connected_components(mesh.face_adjacency, nodes=faces, min_len=1)]


def _volume(triangles: Float[np.ndarray, "F 3 3"]) -> float:
    """Signed: negative if the faces are wound inward."""
    a, b, c = np.moveaxis(triangles - triangles[0, 0], 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6)


def _is_within(part: Float[np.ndarray, "F 3 3"], other: Float[np.ndarray, "H 3 3"]) -> bool:
    """Do all of a part's corners lie in another part?"""
    points = np.unique(part.reshape(-1, 3), axis=0)
    step = max(1, _PAIRS_AT_ONCE // len(other))
    return all(
        (np.abs(winding(points[start : start + step], other)) > 0.25).all()  # 0.5 on a face
        for start in range(0, len(points), step)
    )


def winding(
    points: Float[np.ndarray, "P 3"], triangles: Float[np.ndarray, "F 3 3"]
) -> Float[np.ndarray, "P"]:
    """How often closed faces enclose each point (van Oosterom and Strackee, 1983)."""
    a, b, c = (triangles[None, :, corner] - points[:, None] for corner in range(3))
    long_a, long_b, long_c = (np.linalg.norm(vector, axis=-1) for vector in (a, b, c))
    ab, bc, ca = ((one * other).sum(-1) for one, other in ((a, b), (b, c), (c, a)))
    volume = (a * np.cross(b, c)).sum(-1)
    angles = 2 * np.arctan2(volume, long_a * long_b * long_c + ab * long_c + bc * long_a + ca * long_b)
    return angles.sum(-1) / (4 * np.pi)
