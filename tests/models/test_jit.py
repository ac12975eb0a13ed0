"""Every model and its methods go through `jax.jit` as they are, and give what they give without it."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.models.baselines import Always, CollisionChecker
from doojax.models.builders import BUILDERS
from doojax.planning.recovery import RandomRecovery
from doojax.types import Transition

from .voxel_examples import FLAT, box, rope

VIEW = {name: getattr(FLAT, name) for name in FLAT.__dataclass_fields__}
DISTANCES = {"grippers": 1, "origin": "gripper", "width": 8}
CONFIGS = {
    "dynamics": {"points": 3, "grippers": 1, "origin": "gripper", "width": 8, "members": 2},
    "classifier": DISTANCES,
    "recovery": DISTANCES,
    "deviation": DISTANCES,
    "full_dynamics": {"points": 3, "view": VIEW, "width": 8, "scene_width": 8},
    "voxel_classifier": {"points": 3, "view": VIEW, "width": 8},
    "policy": {"observation": 5, "action": 2, "width": 8, "depth": 2},
    "validity": {"width": 8},
}
PLAIN = {"always": Always, "collision checker": CollisionChecker, "random recovery": RandomRecovery}
KINDS = [*CONFIGS, "member", *PLAIN]


@cache
def model_of(kind: str):
    if kind == "member":
        members = model_of("dynamics").members
        return jax.tree.map(lambda leaf: leaf[0] if eqx.is_array(leaf) else leaf, members)
    return PLAIN[kind]() if kind in PLAIN else eqx.filter_jit(BUILDERS[kind])(CONFIGS[kind])


OBSTACLES, BEFORE, AFTER = box(0.02, 0.03, 0.02), rope(), rope(x=0.03)
ACTION = jnp.array([[0.03, 0.01, 0.0]])


def arguments(kind: str) -> tuple:
    if kind in ("policy", "validity"):
        return (jnp.linspace(-1.0, 1.0, 5 if kind == "policy" else 6),)
    judges = kind in ("classifier", "voxel_classifier", "deviation", "always", "collision checker")
    step = (Transition(BEFORE, ACTION, AFTER, jnp.array(0.01)),) if judges else (BEFORE, ACTION)
    return (OBSTACLES, *step)


def assert_close(one, other):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6), one, other)


def test_no_kind_of_model_is_left_out():
    assert set(CONFIGS) == set(BUILDERS)


@eqx.filter_jit
def passed(function, arguments):
    """The function's result; what it holds is an argument here, not a constant."""
    return function(*arguments)


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_is_jitted_as_it_is(kind):
    model, given = model_of(kind), arguments(kind)
    assert_close(jax.jit(model)(*given), passed(model, given))


def test_methods_of_models_are_jitted_as_they_are():
    ensemble, classifier = model_of("dynamics"), model_of("classifier")
    given = OBSTACLES, BEFORE, jnp.stack([ACTION, -ACTION])
    members = ensemble.roll_out_members
    assert_close(jax.jit(members)(*given), passed(members, given))
    given = arguments("classifier")
    assert_close(jax.jit(classifier.__call__)(*given), passed(classifier, given))


def test_a_model_with_other_weights_is_another_function():
    model, given = model_of("classifier"), arguments("classifier")
    before = jax.jit(model)(*given)
    other = jax.tree.map(lambda leaf: 1.5 * leaf if eqx.is_inexact_array(leaf) else leaf, model)
    assert abs(jax.jit(other)(*given).score - before.score) > 1e-3
    assert_close(jax.jit(other)(*given), passed(other, given))
