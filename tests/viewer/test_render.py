"""Pictures and recordings without a browser; columns by which one filters; meshes."""

import re
import subprocess
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from imageio import v3 as imageio
from imageio_ffmpeg import get_ffmpeg_exe

from doojax.datasets import Dataset
from doojax.experiments.trials.records import PlanRecord
from doojax.types import Obstacles, ShapeKind
from doojax.viewer import colours
from doojax.viewer.columns import Columns, select
from doojax.viewer.examples import write_dataset
from doojax.viewer.films import FROM_SIDE, OTHER_SIDE, clear_side
from doojax.viewer.page import start_server
from doojax.viewer.pictures import contact_sheet
from doojax.viewer.render import most_moving, render
from doojax.viewer.shapes import smooth, tube, turns_from_z
from doojax.viewer.show import node_colours


def orange(pixels: np.ndarray) -> np.ndarray:
    """Where the rope is."""
    red, green, blue = np.moveaxis(pixels[..., :3].astype(int), -1, 0)
    return (red > 140) & (green < 0.65 * red) & (blue < 0.35 * red)


def test_a_trajectory_as_a_picture_shows_its_rope(contents, tmp_path):
    render(contents / "towed", out=tmp_path / "one.png", index=3)
    pixels = imageio.imread(tmp_path / "one.png")
    assert 300 < orange(pixels).sum() < 0.1 * pixels[..., 0].size


def test_a_sheet_has_a_picture_for_each_trajectory(contents, tmp_path):
    contact_sheet(Dataset.open(contents / "towed"), [3, 5], tmp_path / "sheet.png")
    ropes = orange(imageio.imread(tmp_path / "sheet.png"))
    half = ropes.shape[1] // 2
    assert ropes[:, :half].sum() > 200 and ropes[:, half:].sum() > 200


@pytest.mark.parametrize(("x", "side"), [(0.4, OTHER_SIDE), (-0.4, FROM_SIDE)])
def test_a_trial_is_seen_from_where_nothing_hides_it(x, side):
    """A wall of a metre stands to one side of a rope."""
    wall = Obstacles(
        kind=jnp.array([ShapeKind.BOX]),
        centre=jnp.array([[x, 0.0, 0.5]]),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        half_size=jnp.array([[0.05, 2.0, 0.5]]),
        active=jnp.array([True]),
    )
    rope = np.stack([np.zeros(5), np.linspace(-0.2, 0.2, 5), np.full(5, 0.1)], -1)
    assert np.array_equal(clear_side(rope, wall), side)
    parked = replace(wall, active=jnp.array([False]))
    assert np.array_equal(clear_side(rope, parked), FROM_SIDE)


def test_those_that_move_most_are_found(contents):
    dataset = Dataset.open(contents / "towed")
    steps = np.linalg.norm(np.diff(dataset["points"][:][:, :, 0], axis=1), axis=-1)
    assert most_moving(dataset, 3) == sorted(np.argsort(-steps.sum(1))[:3].tolist())


@pytest.mark.parametrize("ending", ["gif", pytest.param("mp4", marks=pytest.mark.slow)])
def test_a_film_moves(tmp_path, ending):
    write_dataset(tmp_path / "short", 1, states=6)
    film = tmp_path / "deep" / f"short.{ending}"
    render(tmp_path / "short", out=film, index=0)
    ropes = [orange(frame) for frame in frames_of(film, tmp_path)]
    assert len(ropes) == 11 and all(rope.sum() > 100 for rope in ropes)
    assert (ropes[0] & ropes[-1]).sum() < 0.8 * ropes[0].sum()


def frames_of(film, folder):
    """The frames, taken apart by ffmpeg itself: imageio leaves its pipes to it open."""
    if film.suffix == ".gif":
        return imageio.imread(film)
    subprocess.run([get_ffmpeg_exe(), "-v", "error", "-i", film, folder / "%03d.png"], check=True)
    return [imageio.imread(picture) for picture in sorted(folder.glob("*.png"))]


def test_a_recording_holds_its_scene(contents, tmp_path):
    render(contents / "prediction.npz", out=tmp_path / "prediction.html", index=1)
    text = (tmp_path / "prediction.html").read_text()
    assert text.lower().startswith("<!doctype html")
    assert not re.search('(src|href)="?https?:', text)  # it needs nothing from elsewhere
    render(contents / "prediction.npz", out=tmp_path / "prediction.viser", index=1)
    assert (tmp_path / "prediction.viser").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("name", "out", "index", "said"),
    [
        ("towed", "a.jpg", None, r"ends in '.jpg', expected one of .png"),
        ("towed", "a.png", 150, "there is no trajectory 150: .* holds 0 to 149"),
        ("trial.npz", "a.png", 0, "is one trial: leave --index out"),
        ("prediction.npz", "a.png", 5, "there is no prediction 5: .* holds 5, counted from 0"),
    ],
)
def test_what_cannot_be_drawn_is_said_and_nothing_is_written(contents, tmp_path, name, out, index, said):
    with pytest.raises(ValueError, match=said):
        render(contents / name, out=tmp_path / "new" / out, index=index)
    assert not (tmp_path / "new").exists()


def test_a_taken_port_is_an_error_that_says_what_to_do(server):
    with pytest.raises(OSError, match=r"cannot serve on 127\.0\.0\.1, port .*; choose another with"):
        start_server("127.0.0.1", server.get_port())


def test_a_node_has_the_colour_of_its_depth_or_its_score():
    plan = PlanRecord(
        step=0,
        parent=np.array([-1, 0, 1, 0]),
        points=np.zeros((4, 2, 3)),
        grippers=np.zeros((4, 1, 3)),
        accepted=np.array([True, True, True, False]),
        path=np.array([0, 1, 2]),
        score=np.array([np.nan, 0.9, 0.5, 0.1]),
    )
    dark, middle, light = colours.scale("viridis", np.array([0.0, 0.5, 1.0])).tolist()
    none, refused = [150, 150, 150], list(colours.REJECTED)
    assert node_colours(plan, "depth").tolist() == [dark, middle, light, refused]
    assert node_colours(plan, "score").tolist() == [none, light, dark, refused]
    unscored = replace(plan, score=None)
    assert node_colours(unscored, "score").tolist() == node_colours(plan, "depth").tolist()


def test_columns_are_what_numpy_finds_in_the_fields(contents):
    dataset = Dataset.open(contents / "towed")
    columns = Columns(dataset, pytest.fail)
    np.testing.assert_allclose(columns["mean stretch, %"], 100 * dataset["stretch"][:].mean(1), rtol=1e-5)
    np.testing.assert_allclose(
        columns["least clearance, mm"], 1000 * dataset["clearance"][:].min(1), rtol=1e-5
    )
    assert (columns["any fault"] == 0).all()
    with pytest.raises(KeyError, match="there is no column 'colour'"):
        columns["colour"]


def test_selecting_orders_stably_and_puts_what_is_missing_last():
    values = np.array([2.0, np.nan, 1.0, 2.0, 3.0])
    assert select(values, None, None, "as stored").tolist() == [0, 1, 2, 3, 4]
    assert select(values, None, None, "descending").tolist() == [4, 0, 3, 2, 1]
    assert select(values, 1.5, 2.5, "ascending").tolist() == [0, 3]


def test_a_tube_is_closed_and_as_wide_as_it_should_be():
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1.0]], dtype=np.float32)
    vertices, faces = tube(points, 0.1)
    away = np.linalg.norm(vertices[:, None] - smooth(points, 200)[None], axis=-1).min(1)
    assert away.max() < 0.101
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(int), axis=1)
    poles = np.isclose(away, 0.1, atol=2e-3)
    assert poles.mean() > 0.9
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert set(counts) <= {1, 2} and (counts == 1).sum() == 20  # open only where the ends' poles meet


def test_turns_take_the_z_axis_where_they_should():
    directions = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0], [0, 0, -1], [0.6, 0, -0.8]])
    w, x, y, z = turns_from_z(directions).T
    turned = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    np.testing.assert_allclose(turned, directions, atol=1e-6)
