"""A trial of arms in the page: links where MuJoCo has them, what was tried by its cost, the plan's ghost."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.experiments.trials.records import Event, Look, TrialRecord
from doojax.experiments.trials.tried import Tried
from doojax.robots import DUAL_ARM
from doojax.tasks.arms import BASE
from doojax.types import Obstacles
from doojax.viewer import colours
from doojax.viewer.draw import linear
from doojax.viewer.page import Page, start_server
from doojax.viewer.trial_page import TrialPage

T, K, H = 3, 4, 2
RANDOM = np.random.default_rng(1)
JOINTS = RANDOM.uniform(-0.5, 0.5, (T + 1, 20)).astype(np.float32)
TRIED = Tried(
    tried=RANDOM.uniform(0, 1, (T, K, H, 3)).round(1),
    tried_cost=np.array([[1.0, 2.0, 3.0, np.nan]] * T),
    planned=RANDOM.uniform(0, 1, (T, H, 3)).round(1),
    planned_joints=RANDOM.uniform(-0.5, 0.5, (T, H, 20)).round(2),
    planned_tool=RANDOM.uniform(0, 1, (T, H, 3)).round(1),
    terms={"reaching": np.array([3.0, 2.0, 1.0])},
)
BOX = Obstacles(
    jnp.zeros(1, int),
    jnp.array([[0.0, 0.9, 0.3]]),
    jnp.array([[1.0, 0, 0, 0]]),
    jnp.full((1, 3), 0.1),
    jnp.ones(1, bool),
)
POINTS = RANDOM.uniform(0, 0.5, (T + 1, 6, 3)).astype(np.float32)
RECORD = TrialRecord(
    task="arm_reaching",
    method="mppi",
    seed=0,
    look=Look(0.01),
    obstacles=BOX,
    goal=np.array([0.0, 0.5, 0.7]),
    goal_radius=0.05,
    goal_point=5,
    points=POINTS,
    grippers=POINTS[:, :2],
    plans=(),
    events=(Event(0, "execute"), Event(T, "end", "the goal is reached")),
    reached=True,
    replay={"joints": JOINTS, **TRIED.packed()},
)


@pytest.fixture(scope="module")
def page():
    server = start_server("127.0.0.1", 0)
    yield Page(server)
    server.stop()


@pytest.fixture(scope="module")
def shown(page, tmp_path_factory):
    made = TrialPage(page, RECORD, tmp_path_factory.mktemp("trial") / "trial.npz")
    yield made
    made.close()


def moving_geoms(joints) -> np.ndarray:
    """Where MuJoCo has the middles of all shapes but the stand, in the world."""
    model = mujoco.MjModel.from_xml_path(str(DUAL_ARM))
    data = mujoco.MjData(model)
    data.qpos[:] = joints
    mujoco.mj_forward(model, data)
    return data.geom_xpos[model.geom_bodyid > 0] + BASE


def places(page, name: str) -> np.ndarray:
    return np.array([one.position for one in page.drawing._handles[name]._meshes])


def test_arms_are_where_mujoco_has_them_and_so_is_the_plans_ghost(shown, page):
    for state in range(T):
        shown.player.go_to(float(state))
        assert places(page, "arms") == pytest.approx(moving_geoms(JOINTS[state]), abs=1e-5)
        ghost = moving_geoms(TRIED.planned_joints[state, -1])
        assert places(page, "planned/arms") == pytest.approx(ghost, abs=2e-3)  # of numbers of 16 bits
    (stand,) = places(page, "arms/stand")
    assert stand == pytest.approx([0, 0, BASE[2] - 0.26])
    assert page.drawing._handles["planned/arms"]._meshes[0].opacity < 1


def test_rollouts_are_lines_from_the_ropes_end_the_cheapest_blue_and_last(shown, page):
    shown.player.go_to(1.0)
    lines = page.drawing._handles["tried"]
    assert lines.points.shape == (3 * H, 2, 3)  # one has no cost
    np.testing.assert_allclose(lines.points[-H, 0], POINTS[1, 5], atol=1e-6)
    np.testing.assert_allclose(lines.points[-H:, 1], TRIED.tried[1, 0], atol=1e-3)
    blue, red = (linear(np.array(colours.SCALES["error"][end], np.uint8)) for end in (0, -1))
    assert (lines.colors[-1] == blue).all() and (lines.colors[0] == red).all()
    assert "3 samples by rank, cost 1 to 3" in shown._view._control._legend.content


def test_what_is_not_wanted_or_was_not_tried_is_not_there(shown, page):
    control = shown._view._control
    control._rollouts.value = False
    page.call(lambda: shown.player.go_to(2.0))
    assert "tried" not in page.drawing._handles and "planned/ways" in page.drawing._handles
    control._rollouts.value = True
    page.call(lambda: shown.player.go_to(float(T)))  # the end, in which nothing was commanded
    assert not {"tried", "planned/ways", "planned/arms"} & set(page.drawing._handles)
    assert "arms" in page.drawing._handles and control._legend.content == ""
