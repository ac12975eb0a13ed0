"""Meshes as obstacles: files of all kinds give one shape, and MuJoCo has the shape that distances know."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

from doojax.geometry.frames import quaternion_from_yaw
from doojax.geometry.sdf import signed_distance
from doojax.simulation.build import build_model
from doojax.simulation.meshes import mesh_obstacle, read_mesh
from doojax.simulation.scenes import Obstacle, obstacles_at, sphere

from .scenes import planar_scene


def stool():
    """A seat on two legs, as three overlapping parts; its underside is a hollow."""
    move = trimesh.transformations.translation_matrix
    seat = trimesh.creation.box((0.3, 0.2, 0.04), move((0, 0, 0.2)))
    legs = [trimesh.creation.box((0.04, 0.2, 0.2), move((x, 0, 0.1))) for x in (-0.1, 0.1)]
    return trimesh.util.concatenate([seat, *legs])


@pytest.mark.parametrize("ending", ["stl", "obj", "glb", "ply"])
def test_every_kind_of_file_gives_the_same_boxes(tmp_path, ending):
    path = tmp_path / f"stool.{ending}"
    mesh = stool()
    mesh.apply_scale(1000)
    mesh.export(path)
    found = mesh_obstacle("stool", path, within=0.02, scale=0.001)
    assert len(found.shapes) == 3
    volumes = sorted(8 * np.prod(shape.half_size) for shape in found.shapes)
    legs, seat = 0.04 * 0.2 * 0.18, 0.3 * 0.2 * 0.04
    assert volumes == pytest.approx([legs, legs, seat], rel=5e-3)
    assert found.height == pytest.approx(0.0, abs=1e-4)


def test_what_is_simulated_is_what_distances_say():
    """The gripper's ball beside and in every obstacle: MuJoCo's distance is ours, less its radius."""
    ball = trimesh.creation.icosphere(2, radius=0.1)
    scene = planar_scene(
        obstacles=(
            mesh_obstacle("stool", stool(), within=0.02),
            Obstacle("ball", (sphere(0.06, offset=(0.02, 0.0, 0.01)),)),
            mesh_obstacle("lumps", ball, within=0.04),
        )
    )
    model = build_model(scene)
    data = mujoco.MjData(model)
    random = np.random.default_rng(0)
    position = np.array([[0.0, 0.0, 0.0], [0.5, 0.1, 0.2], [-0.5, 0.1, 0.3]])
    quaternion = np.array([quaternion_from_yaw(jnp.asarray(yaw)) for yaw in (0.3, 1.0, 2.0)])
    data.mocap_pos[:], data.mocap_quat[:] = position, quaternion
    mujoco.mj_kinematics(model, data)
    hands = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
    mocap = model.body_mocapid[model.geom_bodyid] >= 0
    (hand,) = [g for g in hands if not mocap[g]]
    others = np.flatnonzero(mocap)
    assert len(others) == sum(len(obstacle.shapes) for obstacle in scene.obstacles)
    spread = random.uniform(0.02, 0.3, (60, 1))  # as many near the middle as far out
    points = position[random.integers(0, 3, 60)] + spread * random.uniform(-1, 1, (60, 3))
    obstacles = obstacles_at(scene, jnp.asarray(position, float), jnp.asarray(quaternion, float))
    ours = np.asarray(signed_distance(obstacles, jnp.asarray(points, float))) - model.geom_size[hand, 0]
    theirs = []
    for point in points:
        data.geom_xpos[hand] = point
        theirs.append(min(mujoco.mj_geomDistance(model, data, hand, g, 2.0, None) for g in others))
    outside = ours > 0  # inside, MuJoCo says how deep one would have to be pushed out, by its own measure
    assert outside.sum() > 30 and (~outside).sum() > 3
    np.testing.assert_allclose(ours[outside], np.array(theirs)[outside], atol=2e-5)
    assert (np.array(theirs)[~outside] <= 1e-6).all()


def test_what_is_no_closed_mesh_is_refused_with_advice(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        read_mesh(tmp_path / "none.stl")
    (tmp_path / "notes.txt").write_text("no mesh")
    with pytest.raises(ValueError, match=r"no mesh that trimesh reads: .* \.stl, \.obj, \.glb or \.ply"):
        read_mesh(tmp_path / "notes.txt")
    (tmp_path / "broken.glb").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="cannot be read as a mesh"):
        read_mesh(tmp_path / "broken.glb")
    opened = trimesh.creation.box((0.1, 0.1, 0.1))
    opened.update_faces(np.arange(len(opened.faces)) > 1)
    opened.export(tmp_path / "open.stl")
    with pytest.raises(ValueError, match=r"obstacle 'lid': the mesh is not watertight.*fill_holes"):
        mesh_obstacle("lid", tmp_path / "open.stl", within=0.01)
    with pytest.raises(ValueError, match=r"scale is 0\.0"):
        mesh_obstacle("lid", stool(), within=0.01, scale=0.0)
