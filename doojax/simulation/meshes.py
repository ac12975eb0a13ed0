"""Obstacles from files of meshes: STL, OBJ, GLB and whatever else trimesh reads."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from doojax.geometry.mesh_boxes import covering_boxes
from doojax.simulation.scenes import Obstacle, Shape
from doojax.types import ShapeKind

if TYPE_CHECKING:
    from trimesh import Trimesh
else:
    Trimesh = Any  # trimesh is not loaded before a mesh exists


def mesh_obstacle(
    name: str,
    mesh: Path | str | Trimesh,
    *,
    within: float,
    scale: float = 1.0,
    friction: float = 0.0,
    most: int = 256,
) -> Obstacle:
    """An obstacle from a closed mesh: boxes that cover it, for simulation and planning alike.

    Every engine, every distance and every data set has the same boxes, so that a plan is as safe from what is
    Every engine, every distance and every data set has the same boxes, so that a plan is as safe from what is
    becomes steps of about that height, on which a rope may catch: fewer metres and more boxes are closer to
    the truth, and slower.

    Args:
        name: of the obstacle; unlike all others in a scene.
        mesh: a file, or a `trimesh.Trimesh`. Its axes are kept: put it so that z is up (glTF has y up).
        within: how far (m) boxes may stick out of the mesh.
        scale: metres for each unit of the file, such as 0.001 for millimetres.
        friction: Coulomb's coefficient; the rope's counts where it is larger.
        most: boxes there may be.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is none that trimesh reads, the mesh is not closed (the message says what mends
            it, if something does), or ``most`` boxes are not enough.
    """
    solid = read_mesh(Path(mesh)) if isinstance(mesh, Path | str) else mesh
    if not scale > 0:
        raise ValueError(f"scale is {scale}, expected metres for each unit of the file: more than 0")
    if scale != 1.0:
        solid = solid.copy()
        solid.apply_scale(scale)
    try:
        boxes = covering_boxes(solid, within, most)
    except ValueError as error:
        raise ValueError(f"the mesh of obstacle {name!r}: {error}") from error
    halves, middles = (boxes[:, 1] - boxes[:, 0]) / 2, boxes.mean(1)
    pairs = zip(halves.tolist(), middles.tolist(), strict=True)
    return Obstacle(name, tuple(Shape(ShapeKind.BOX, (*half,), (*at,)) for half, at in pairs), friction)


def read_mesh(path: Path) -> Trimesh:
    """All that a file shows, in place, as one mesh in the file's units and axes.

    Corners that files keep apart, for textures or shading, are joined.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: trimesh does not read it.
    """
    import trimesh

    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    if path.suffix[1:].lower() not in trimesh.available_formats():
        raise ValueError(
            f"{path} is no mesh that trimesh reads: expected a name that ends in .stl, .obj, .glb or .ply"
        )
    try:
        mesh = trimesh.load_scene(path).to_mesh()
    except Exception as error:  # trimesh's readers raise anything
        raise ValueError(f"{path} cannot be read as a mesh: {type(error).__name__}: {error}") from error
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh
