"""A robot's page: links where MuJoCo has them, whether it is free, targets that its tools reach or not."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from doojax.robots import DUAL_ARM, read_robot
from doojax.viewer.app import meant_by
from doojax.viewer.episodes import rotation_matrices
from doojax.viewer.page import Page, start_server
from doojax.viewer.robot_page import RobotPage
from doojax.viewer.robots import LINK, STAND, TOUCHES

# Two links in the plane z = 0.3, and a post from the floor beside them: 0.4 to 0.6 along x, from y = 0.25 on.
PLANAR = """
<mujoco model="planar">
  <compiler autolimits="true"/>
  <worldbody>
    <geom type="box" pos="0.5 0.35 0.35" size="0.1 0.1 0.35"/>
    <body name="upper" pos="0 0 0.3">
      <joint name="shoulder" axis="0 0 1" range="-120 120"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03"/>
        <site name="tip" pos="0.25 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "planar.xml"
    path.write_text(PLANAR)
    return path


@pytest.fixture(scope="module")
def page():
    server = start_server("127.0.0.1", 0)
    yield Page(server)
    server.stop()


@pytest.fixture(scope="module")
def shown(file, page):
    made = RobotPage(page, read_robot(file), file)
    made.begun.join()
    return made


def links(page):
    return page.drawing._handles["robot"]._meshes


def test_links_are_where_mujoco_has_them(shown, page, file):
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    first = links(page)
    for joints in ([0.3, -1.2], [-0.7, 2.5]):
        shown.set(np.array(joints, np.float32))
        data.qpos[:] = joints
        mujoco.mj_forward(model, data)
        assert links(page) is first  # meshes move, and are not sent again
        places = np.array([one.position for one in first])
        np.testing.assert_allclose(places, data.geom_xpos[1:], atol=1e-6)
        axes = rotation_matrices(np.array([one.wxyz for one in first]))[:, :, 2]
        along = np.abs((axes * data.geom_xmat[1:].reshape(-1, 3, 3)[:, :, 2]).sum(-1))
        np.testing.assert_allclose(along, 1, atol=1e-6)
        x, y, z = data.site("tip").xpos
        assert re.search(rf"tip: x {x:.3f}, y {y:.3f}, z {z:.3f} m", shown._facts.content.replace("\\", ""))
        assert [slider.value for slider in shown.sliders] == pytest.approx(joints, abs=1e-3)


@pytest.mark.parametrize(
    ("degrees", "said", "touches"),
    [
        # the lower link's end is 25 cm below the post's face, the floor 30 cm below the links' axes
        ((0, 0), "free: 220 mm to what is nearest", (False, False)),
        # its end is at (0.3, 0.2), so 10 cm beside the post's edge and 5 cm before it
        ((0, 90), "free: 82 mm to what is nearest", (False, False)),
        # it ends at (0.383, 0.321), 1.7 cm beside the post
        ((40, 0), "not free**: 13 mm deep", (False, True)),
    ],
)
def test_whether_it_is_free_is_said_and_seen(shown, page, degrees, said, touches):
    shown.set(np.radians(degrees).astype(np.float32))
    assert said in shown._facts.content
    assert [tuple(one.color) for one in links(page)] == [TOUCHES if one else LINK for one in touches]
    assert tuple(page.drawing._handles["robot/stand"]._meshes[0].color) == STAND


def test_a_tool_comes_to_its_target_by_a_posture_that_is_free(shown, page):
    # two postures lead there: by (15, 50) degrees the lower link touches the post, by (60, -50) nothing does
    upper, lower = np.radians([15, 65])
    place = 0.3 * np.array([np.cos(upper), np.sin(upper)]) + 0.25 * np.array([np.cos(lower), np.sin(lower)])
    shown.set(np.radians([15.0, 50.0]).astype(np.float32))
    before = shown._facts.content
    shown.targets[0].position = (*place, 0.3)
    page.call(lambda: shown.solve(0))
    assert "not free" in before and "not free" not in shown._facts.content
    assert np.degrees(shown.joints) == pytest.approx([60.1, -50], abs=0.5)
    x, y = 0.3 * np.cos(shown.joints[0]), 0.3 * np.sin(shown.joints[0])
    tip = (
        x + 0.25 * np.cos(shown.joints.sum(dtype=float)),
        y + 0.25 * np.sin(shown.joints.sum(dtype=float)),
    )
    assert np.linalg.norm(np.array(tip) - place) < 1e-3


def test_what_cannot_be_reached_is_told_and_the_robot_stays(shown, page):
    shown.set(np.array([0.2, 0.1], np.float32))
    shown.targets[0].position = (0.0, 2.0, 0.3)  # the arm reaches 0.55 m
    page.call(lambda: shown.solve(0), aloud=False)
    assert page.message.visible and "1 of 1 poses are not reached: of the first the tool stays 1" in (
        page.message.content.replace("\\", "")
    )
    assert shown.joints == pytest.approx([0.2, 0.1])


def test_the_robot_that_comes_along_has_a_name_unless_something_else_has_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert meant_by(Path("dual_arm")) == DUAL_ARM
    (tmp_path / "dual_arm").mkdir()
    assert meant_by(Path("dual_arm")) == Path("dual_arm")


def test_sliders_move_it_in_a_browser(view, file):
    look, app = view(file)
    look.wait_for("free: 220 mm to what is nearest")
    red = seen_red(look)
    look.slide("shoulder", (40 + 120) / 240)
    look.wait_for(re.compile("^not free"))
    look.until(lambda: seen_red(look) > red + 200)
    look.enter("elbow", 1.2)
    look.until(lambda: abs(app._content.joints[1] - 1.2) < 1e-3)


def seen_red(look) -> int:
    """How many pixels have the colour of what touches."""
    red, green, blue = np.moveaxis(look.pixels(), -1, 0)
    return int(((red > 120) & (green < 90) & (blue < 90)).sum())
