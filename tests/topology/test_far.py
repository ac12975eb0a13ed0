"""Topology in map coordinates: the same as at the origin, or refused; never another number."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from doojax import topology as t
from doojax.topology.describe import THREADING, read_scene, signature
from doojax.types import Obstacles

from . import curves
from .oracle import oracle_linking_number, oracle_margin

FAR = np.array([388096.0, 3948996.0, 40.0])


def random_pairs(count, seed=0):
    rng = np.random.default_rng(seed)
    return [[curves.closed(rng.normal(size=(8, 3)) * 5) for _ in range(2)] for _ in range(count)]


def test_linking_numbers_in_map_coordinates_are_those_at_the_origin():
    for pair in random_pairs(20):
        far = [np.round(loop + FAR, 3) for loop in pair]
        number, _ = oracle_linking_number(*(loop - FAR for loop in far))
        assert t.linking_number(*far) == number
        assert t.linking_number(*(loop.tolist() for loop in far)) == number


def test_what_single_precision_cannot_tell_is_flagged_in_jit_and_refused_outside():
    pairs = random_pairs(60, seed=1)
    far = [[(loop + FAR).astype(np.float32) for loop in pair] for pair in pairs]
    found = jax.jit(jax.vmap(t.linking_of))(*(jnp.stack(loops) for loops in zip(*far, strict=True)))
    right = np.array([oracle_linking_number(*pair)[0] for pair in pairs])
    apart = np.array([oracle_margin(*pair) for pair in pairs])
    assert (np.asarray(found.number) != right).any(), "some are wrong, as they must be"
    assert (np.asarray(found.number) == right)[~np.asarray(found.touching)].all()
    assert not np.asarray(found.touching)[apart > 2.0].any()  # rounding moves points by up to 0.43 m
    doubtful = int(np.flatnonzero(found.touching)[0])
    with pytest.raises(ValueError, match=r"single precision rounds .* give them in double precision|touch"):
        t.linking_number(*far[doubtful])
    close = [curves.circle(count=8), curves.circle(centre=(1.3, 0, 0), axes=(0, 2), count=8)]
    with pytest.raises(ValueError, match=r"single precision .* of up to 3948\d{3}\.?\d* m by as much"):
        t.linking_number(*((loop + FAR).astype(np.float32) for loop in close))
    assert abs(t.linking_number(*(loop + FAR for loop in close))) == 1


def scene_at(offset):
    """The example's scene, moved."""
    scene = json.loads(THREADING.read_text())
    scene["skeleton"] = {name: (loop + offset).tolist() for name, loop in scene["skeleton"].items()}
    scene["rope"], scene["base"] = ((np.array(scene[key]) + offset).tolist() for key in ("rope", "base"))
    for holder in (*scene["grippers"].values(), *scene["attachments"].values()):
        holder["path"] = [(np.array(point) + offset).tolist() for point in holder["path"]]
    return scene


def test_a_described_scene_has_the_same_signature_in_map_coordinates(tmp_path, capsys):
    for name, offset in (("near", np.zeros(3)), ("far", FAR)):
        (tmp_path / name).write_text(json.dumps(scene_at(offset)))
        signature(tmp_path / name)
    near, far = capsys.readouterr().out.split("{")[1:]
    assert near == far
    scenes = read_scene(tmp_path / "near"), read_scene(tmp_path / "far")
    assert scenes[0].origin == (0, 0, 0)
    np.testing.assert_allclose(scenes[1].origin, scene_at(FAR)["base"])
    moved = np.asarray(scenes[1].skeleton.loops, np.float64) + scenes[1].origin - FAR
    np.testing.assert_allclose(moved, scenes[0].skeleton.loops, atol=1e-5)
    broken = scene_at(FAR) | {"rope": [[0, 0, "x"]]}
    (tmp_path / "broken").write_text(json.dumps(broken))
    with pytest.raises(ValueError, match=r"broken does not describe a scene: the rope: .* is 'x'"):
        read_scene(tmp_path / "broken")


def test_grasps_and_skeletons_in_map_coordinates_are_refused_and_the_advice_helps():
    rope, base = np.array([[0, 0, 1.0], [0, 0, -1]]), np.array([3.0, 0, 0])
    with pytest.raises(
        ValueError, match=r"the rope, the base and the paths .* subtract a common origin, such as"
    ):
        t.make_grasps(rope + FAR, base + FAR, {"right": t.Holder(0.5)})
    with pytest.raises(ValueError, match="of skeleton loop 'ring' are up to 3948997 m, which float32 rounds"):
        t.make_skeleton({"ring": curves.circle() + FAR})
    t.make_grasps(rope + FAR - FAR, base, {"right": t.Holder(0.5)})
    t.make_skeleton({"ring": curves.circle() + FAR - FAR})


def test_skeletons_of_solids_in_map_coordinates():
    ring = trimesh.creation.torus(0.1, 0.03, major_sections=16, minor_sections=8)
    ring.apply_translation(FAR)
    with pytest.raises(ValueError, match=r"of the mesh are .* mesh\.apply_translation\(-mesh\.centroid\)"):
        t.mesh_skeleton(ring, 0.02)
    ring.apply_translation(-ring.centroid)
    assert len(t.mesh_skeleton(ring, 0.02).names) == 1
    with pytest.raises(ValueError, match=r"expected a trimesh\.Trimesh, got a trimesh\.Scene"):
        t.mesh_skeleton(trimesh.Scene(ring), 0.02)
    box = Obstacles(
        jnp.zeros(1, int),
        jnp.asarray(FAR)[None],
        jnp.array([[1.0, 0, 0, 0]]),
        jnp.ones((1, 3)),
        jnp.ones(1, bool),
    )
    with pytest.raises(ValueError, match=r"rounded to 0.5 m in float32, too coarse for voxels of 0.2 m"):
        t.obstacle_skeleton(box, 0.2)


def test_broadcasting_is_said():
    """Under strict rank promotion, as `jax.numpy_rank_promotion` asks for."""
    scene = read_scene(THREADING)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), scene.grasps)
    loop, point = jnp.ones((5, 3)), jnp.ones(3)
    one, two = (t.Signature.of([(1, 0, 0)] * count, 3) for count in (1, 2))
    with jax.numpy_rank_promotion("raise"):
        for function in (
            lambda: t.signature(scene.grasps, scene.skeleton),
            lambda: t.signature(scene.grasps, t.make_skeleton({}), remove_empty=False),
            lambda: jax.vmap(t.signature, (0, None))(many, scene.skeleton),
            lambda: t.loops_of(scene.grasps),
            lambda: t.linking_of(loop, loop),
            lambda: jax.grad(lambda at: t.magnetic_field(loop, at).sum())(point),
            lambda: t.field_line(loop, point, step=0.1, count=4),
            lambda: (t.same(one, two), t.distance(one, two)),
            lambda: t.Blocklist.empty(3, one).add(one).contains(one),
        ):
            eqx.filter_eval_shape(function)
