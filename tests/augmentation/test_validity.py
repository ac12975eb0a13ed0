"""Which transforms are valid: tried, learned, and kept to."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.augmentation import augment, setting_of
from doojax.augmentation.command import augment_dataset
from doojax.augmentation.examples import Bounds
from doojax.augmentation.resimulation import drawn_examples
from doojax.augmentation.validity import transform_errors, usual_count
from doojax.commands import parsed
from doojax.datasets import Dataset
from doojax.datasets.collect import collect, command_of
from doojax.experiments.training.validity import train_validity
from doojax.keys import numbered, stream
from doojax.learning.checkpoints import load_model, save_model
from doojax.learning.fit import fit, member
from doojax.learning.validity import ValidityProblem, validity_fit
from doojax.models.validity import TransformValidity, ValidityConfig
from doojax.tasks import make_task
from doojax.tasks.ropes import OtherRope, with_rope
from doojax.types import Verdict

SMALL = ValidityConfig(width=32, depth=2)


def turned(axis, angle):
    return jnp.zeros(6).at[3 + axis].set(angle)


def test_the_thesis_tries_as_many_as_dimensions_ask_for():
    assert usual_count(Bounds()) == 100  # three translations and a turn
    assert usual_count(Bounds((0.25, 0.25, 0.0), (0.0, 0.0, 0.5))) == 31
    assert usual_count(Bounds(rotation=(1.0, 1.0, 1.0))) == 1000


def test_what_errs_by_less_than_the_limit_counts_for_nothing_and_has_no_gradient():
    model = TransformValidity(SMALL, key=jax.random.key(0))
    error = float(model.error(turned(0, 1.0)))
    assert error > 0
    for limit, expected in ((2 * error, 0.0), (0.5 * error, 0.5 * error)):
        limited = model.limited(limit)
        assert float(limited(turned(0, 1.0))) == pytest.approx(expected, rel=1e-5)
        assert bool(jax.grad(limited)(turned(0, 1.0)).any()) == (expected > 0)


def test_errors_that_only_tilts_make_are_learned():
    """0.1 m for a radian about x or y, in truth."""
    keys = jax.random.split(jax.random.key(1), 2)
    transforms = jax.random.uniform(keys[0], (600, 6), minval=-1.0, maxval=1.0)
    errors = 0.1 * jnp.linalg.norm(transforms[:, 3:5], axis=1)
    problem = ValidityProblem(transforms[:500], errors[:500], (transforms[500:], errors[500:]), SMALL)
    model = member(fit(problem, validity_fit(500, 60), seed=0), 0)
    off = jnp.abs(jax.vmap(model.error)(transforms[500:]) - errors[500:])
    assert float(off.mean()) < 0.006  # a constant would be 0.023 off
    assert float(model.error(turned(2, 0.5))) < 0.02 < 0.03 < float(model.error(turned(0, 0.5)))


def test_up_is_seen_not_only_angles():
    """A network that is blind for the six numbers sees no turn about the upright, and others."""
    model = TransformValidity(SMALL, key=jax.random.key(0))
    blind = jnp.zeros_like(model.network.layers[0].weight[:, :6])
    model = eqx.tree_at(
        lambda one: one.network.layers[0].weight, model, replace_fn=lambda w: w.at[:, :6].set(blind)
    )
    upright = [float(model.error(turned(2, angle))) for angle in (0.0, 1.0, 3.0)]
    assert upright[1:] == pytest.approx(upright[:1] * 2, rel=1e-5)
    assert abs(float(model.error(turned(0, 1.0))) - upright[0]) > 1e-4


@pytest.mark.slow
def test_where_all_places_are_alike_every_transform_is_found_valid():
    task = make_task("toy", phase="unconstrained")
    found = transform_errors(task, task.simulator("mujoco"), Bounds((0.2, 0.2, 0.0), (0.0, 0.0, 1.0)), 70, 0)
    assert found.transforms.shape == (70, 6) and found.errors.shape == (70,)
    size = np.abs(found.transforms[:, 5])
    assert size[:20].max() < 0.3 < size[-20:].max() <= 1.0  # the later, the larger
    assert found.errors.max() < 1e-5


@pytest.mark.slow
def test_an_augmentation_keeps_to_what_is_valid():
    task = make_task("toy", phase="unconstrained")
    setting = setting_of(task, Bounds((0.2, 0.2, 0.0), (0.0, 0.0, 1.0)))
    _, examples = drawn_examples(task, task.simulator("mujoco"), 32, stream(0, "a"), stream(0, "b"))
    keys = numbered(stream(0, "test"), range(32))

    def at_most_a_tenth(parameters):
        return jnp.maximum(jnp.abs(parameters[5]) - 0.1, 0.0)

    free, kept = augment(keys, examples, setting), augment(keys, examples, setting, validity=at_most_a_tenth)
    angles = [np.abs(np.asarray(found.transform[:, 5])) for found in (free, kept)]
    assert np.nanmax(angles[0]) > 0.3 and np.nanmax(angles[1]) <= 0.1 + 1e-6
    assert (np.asarray(kept.verdict) == Verdict.ACCEPTED).sum() > 16


@pytest.mark.slow
def test_what_was_learned_is_used_by_the_command_and_recorded(tmp_path):
    bounds = {"translation": (0.2, 0.2, 0.0), "rotation": (0.0, 0.0, 1.0)}
    train_validity("toy", out=tmp_path / "validity", transforms=20, epochs=2, **bounds)
    model, header = load_model(tmp_path / "validity", task="toy", kind="validity")
    assert float(model.limit) == pytest.approx(0.02) and header.about["valid_fraction"] == 1.0
    collect("toy", trajectories=8, states=3, out=tmp_path / "data")
    augment_dataset(tmp_path / "data", out=tmp_path / "out", copies=1, validity=tmp_path / "validity")
    made = Dataset.open(tmp_path / "out")
    ((_, given),) = parsed(command_of(made.manifest, tmp_path / "out"))
    assert given["validity"] == tmp_path / "validity"
    about = header.about | {"rope": {"mass": 0.3}}
    save_model(tmp_path / "heavy.eqx", replace(header, about=about), model)
    with pytest.raises(ValueError, match=r"is of another rope than .*data: {'mass': 0.3} and the task's own"):
        augment_dataset(tmp_path / "data", out=tmp_path / "no", copies=1, validity=tmp_path / "heavy.eqx")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("planar_pushing", {}, "planar_pushing has no rope: in its plane every transform is valid"),
        ("toy", {"limit": 0.0}, "limit is 0.0, expected more than 0 m"),
        ("toy", {"transforms": 9}, "transforms is 9, expected at least 10"),
    ],
)
def test_what_cannot_be_learned_is_refused(tmp_path, task, options, message):
    with pytest.raises(ValueError, match=message):
        train_validity(task, out=tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_limp_rope_falls_when_it_is_laid_on_its_side_and_a_stiffer_one_less():
    """But it does, too: hands hold ropes at a point, about which they turn."""
    base = make_task("dual_gripper", phase="unconstrained")
    bounds = Bounds((0.0, 0.0, 0.0), (1.6, 0.0, 0.0))
    limp, stiff = (
        transform_errors(task, task.simulator("mujoco"), bounds, 40, 0)
        for task in (base, with_rope(base, OtherRope(bending_stiffness=0.5, twisting_stiffness=0.5)))
    )
    np.testing.assert_array_equal(limp.transforms, stiff.transforms)
    large, small = np.abs(limp.transforms[:, 3]) > 0.7, np.abs(limp.transforms[:, 3]) < 0.1
    assert large.sum() > 4 and small.sum() > 4
    assert limp.errors[small].max() < 0.02 < 0.05 < limp.errors[large].min()
    assert (stiff.errors[large] < limp.errors[large]).all()
