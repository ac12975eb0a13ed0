"""Hands that arms carry: what is accepted can be carried out, by MuJoCo's own check; the rest is told."""

from functools import cached_property

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.experiments.trials.carried import arms_of, refusals, with_arms
from doojax.experiments.trials.judges import threshold_of
from doojax.experiments.trials.methods import make_method
from doojax.experiments.trials.records import Event, Look, TrialRecord
from doojax.goals import goal_of
from doojax.models import Always, Conjunction
from doojax.models.arms import TOLERANCE, ArmsFeasible
from doojax.robots import DUAL_ARM, read_robot
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.tasks import make_task
from doojax.types import Obstacles, RopeState, Transition
from tests.robots.small_arms import SMALL, STARTS
from tests.simulation.scenes import no_start

TASK = make_task("dual_gripper")
TABLE, BOX = ((0.8, 0.0, 0.565), (0.4, 0.75, 0.06)), ((0.6, 0.1, 0.775), (0.06, 0.06, 0.15))
OBSTACLES = Obstacles(
    jnp.zeros(2, int),
    jnp.array([TABLE[0], BOX[0]]),
    jnp.tile(jnp.array([1.0, 0, 0, 0]), (2, 1)),
    jnp.array([TABLE[1], BOX[1]]),
    jnp.ones(2, bool),
)


class Case:
    """Arms, as a judge, and their file."""

    def __init__(self, file: str, arms: ArmsFeasible, judge: Conjunction):
        self.file, self.arms, self.judge = file, arms, judge

    @cached_property
    def accepted(self) -> np.ndarray:
        """Which of `HANDS` may be gone to, from where they are."""

        @jax.jit
        def judged(hands):
            def one(hands):
                state = state_of(hands)
                return self.judge(OBSTACLES, Transition(state, jnp.zeros((2, 3)), state, jnp.zeros(())))

            return jax.lax.map(one, hands, batch_size=8)

        found = judged(HANDS)
        assert not np.asarray(found.accepted & ~found.possible).any()
        return np.asarray(found.accepted)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The arms where they stand, and the obstacles, in MuJoCo."""
        spec = mujoco.MjSpec()
        turn = [np.cos(self.arms.yaw / 2), 0, 0, np.sin(self.arms.yaw / 2)]
        frame = spec.worldbody.add_frame(pos=list(self.arms.base), quat=turn)
        spec.attach(mujoco.MjSpec.from_file(self.file), prefix="arm_", frame=frame)
        for name, (centre, size) in {"table": TABLE, "box": BOX}.items():
            spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=size)
        return spec.compile()


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Case:
    file = tmp_path_factory.mktemp("arms") / "small.xml"
    file.write_text(SMALL)
    arms = ArmsFeasible(read_robot(file), STARTS, (0.0, 0.0, 0.9), 0.0, tuple(range(6)), 0.002)
    return Case(str(file), arms, Conjunction((Always(), arms)))


@pytest.fixture(scope="module")
def dual() -> Case:
    """As `doojax plan --arms` has them."""
    simulator = MujocoSimulator(TASK.scene, start=no_start)
    method = make_method("collision_checker", TASK, simulator, {}, arms=True)
    assert method.arms is not None
    return Case(str(DUAL_ARM), method.arms, method.reliability)


def hands_of(count: int) -> np.ndarray:
    """Pairs of hands over the table, the left one to the left, no farther apart than the rope lets them."""
    random = np.random.default_rng(0)
    middle = random.uniform((0.35, -0.2, 0.7), (0.7, 0.2, 1.2), (count, 3))
    half = random.uniform((-0.1, 0.1, -0.1), (0.1, 0.3, 0.1), (count, 3))
    return np.stack([middle + half, middle - half], axis=1).astype(np.float32)


def state_of(hands) -> RopeState:
    """A straight rope between hands."""
    along = (jnp.arange(25) + 0.5) / 25
    return RopeState(hands[0] + along[:, None] * (hands[1] - hands[0]), hands)


HANDS = hands_of(40)


def record_of(hands) -> TrialRecord:
    states = jax.vmap(state_of)(jnp.asarray(hands))
    return TrialRecord(
        task="dual_gripper",
        method="collision_checker",
        seed=0,
        look=Look(0.01),
        obstacles=OBSTACLES,
        goal=np.array([0.8, 0.0, 0.9]),
        goal_radius=0.05,
        goal_point=12,
        points=np.asarray(states.points),
        grippers=np.asarray(states.grippers),
        plans=(),
        events=(Event(0, "end", "goal reached"),),
        reached=True,
    )


def check_with_mujoco(case: Case) -> None:
    """What is accepted has joints within limits that bring MuJoCo's sites to the hands, and touch nothing."""
    accepted, model = case.accepted, case.model
    assert 5 < accepted.sum() < len(HANDS)  # else nothing would be said below
    record = with_arms(record_of(HANDS[accepted]), case.arms)
    joints = record.replay["joints"]
    assert record.about["arms"]["carried"] == record.about["arms"]["states"] == len(joints)
    data = mujoco.MjData(model)
    links = [g for g in range(model.ngeom) if model.geom_bodyid[g] and model.geom_contype[g]]
    for hands, posture in zip(HANDS[accepted], joints, strict=True):
        assert (posture >= model.jnt_range[:, 0] - 1e-5).all()
        assert (posture <= model.jnt_range[:, 1] + 1e-5).all()
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        tools = np.stack([data.site(f"arm_{name}").xpos for name in ("left", "right")])
        assert np.linalg.norm(tools - hands, axis=1).max() < TOLERANCE + 1e-4
        for obstacle in (model.geom("table").id, model.geom("box").id):
            least = min(mujoco.mj_geomDistance(model, data, link, obstacle, 1.0, None) for link in links)
            assert least > 0


@pytest.mark.slow
def test_what_is_accepted_can_be_carried_out_by_mujocos_own_check(small):
    check_with_mujoco(small)


@pytest.mark.slow  # compiling takes half a minute; beside it the same of smaller arms
def test_so_it_is_of_the_dual_arm_before_the_table(dual):
    check_with_mujoco(dual)


@pytest.mark.slow
def test_the_record_says_which_states_no_arms_carry(small):
    hands = HANDS[small.accepted][:3].copy()
    hands[1] += (2.0, 0, 0)
    record = with_arms(record_of(hands), small.arms)
    said = record.about["arms"]
    assert (said["states"], said["carried"]) == (3, 2)
    assert (said["base"], said["yaw"]) == ([0.0, 0.0, 0.9], 0.0)
    assert np.isnan(record.replay["joints"]).all(1).tolist() == [False, True, False]


def goals_of(*targets):
    """Of a target of the rope's middle, or of a hand."""
    found = [goal_of([jnp.array(place)], [[body]], 27, 0.05) for place, body in targets]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)


@pytest.mark.slow
def test_a_goal_out_of_the_arms_reach_and_a_start_that_they_cannot_hold_are_told(small):
    good = HANDS[small.accepted][0]
    in_the_table = np.array([[0.6, 0.2, 0.6], [0.6, -0.2, 0.6]], np.float32)
    starts = [good, good, good, good + np.array([2.0, 0, 0], np.float32), in_the_table]
    states = jax.vmap(state_of)(jnp.asarray(np.stack(starts)))
    near, far = ((0.6, 0.0, 0.9), 12), ((1.5, 0.0, 0.9), 12)
    # arms are 0.8 m long from (0, 0.2, 0.9) and (0, -0.2, 0.9): 1.51 m lack to `far`, 0.39 m of rope follow
    goals = goals_of(near, far, ((0.6, -0.7, 0.9), 25), near, near)
    obstacles = jax.tree.map(lambda leaf: jnp.stack([leaf] * len(starts)), OBSTACLES)
    told = refusals(small.arms, TASK, obstacles, states, goals)
    assert told[0] == ""
    assert told[1].startswith("the goal [1.5, 0.0, 0.9] is out of the arms' reach: the ")
    assert "tool stays 0.71 m away, and there are 0.40 m of rope between its hand and what" in told[1]
    # hand 0 is the left tool: sqrt(0.6^2 + 0.9^2) - 0.8 m
    assert told[2].startswith(
        "the goal [0.6, -0.7, 0.9] is out of the arms' reach: the left tool stays 0.28 m"
    )
    assert "there are 0.00 m of rope" in told[2]
    assert told[3].startswith("the arms cannot be where the hands begin: a tool stays ")
    assert told[4] == "the arms cannot be where the hands begin without touching anything"


def test_scores_are_those_of_the_method_and_other_tasks_have_no_arms(dual):
    assert threshold_of(dual.judge) == pytest.approx(0.02)  # the collision checker's margin
    assert dual.judge.judges[1] is dual.arms and dual.arms.base == TASK.arms_base
    toy = make_task("toy")
    with pytest.raises(ValueError, match="task 'toy' has no arms: it does not say where a robot stands"):
        arms_of(toy)
