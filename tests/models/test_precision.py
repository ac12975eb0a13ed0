"""Models in double precision and under strict rank promotion: they load, and say what they always say."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax import experiments
from doojax.learning.checkpoints import Header, load_model, save_model
from doojax.models.local import local_frame
from doojax.models.rolling import roll_out

from .test_jit import ACTION, BEFORE, CONFIGS, KINDS, arguments, model_of, passed
from .voxel_examples import rope

SHIPPED = sorted((Path(experiments.__file__).parent / "pretrained").rglob("*.eqx"))


def wide(tree):
    """In double precision."""
    return jax.tree.map(lambda leaf: leaf.astype(float) if eqx.is_inexact_array(leaf) else leaf, tree)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: f"{path.parent.name} {path.stem}")
def test_shipped_models_load_in_double_precision_with_the_same_weights(path):
    single, header = load_model(path)
    with jax.enable_x64(True):
        double, same_header = load_model(path)
    assert header == same_header
    pairs = list(zip(*(jax.tree.leaves(eqx.filter(m, eqx.is_array)) for m in (single, double)), strict=True))
    assert pairs
    for one, other in pairs:
        assert (one.dtype, other.dtype) == (jnp.float32, jnp.float64)
        np.testing.assert_array_equal(one, other)


def test_a_model_computes_in_double_precision_what_it_computes_in_single(tmp_path):
    kind = "dynamics"
    save_model(tmp_path / "model.eqx", Header(kind, "toy", CONFIGS[kind]), model_of(kind))
    single = passed(model_of(kind), arguments(kind))
    with jax.enable_x64(True):
        model, _ = load_model(tmp_path / "model.eqx")
        double = passed(model, wide(arguments(kind)))
        save_model(tmp_path / "double.eqx", Header(kind, "toy", CONFIGS[kind]), model)
    for one, other in zip(jax.tree.leaves(single), jax.tree.leaves(double), strict=True):
        assert other.dtype == jnp.float64
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)
    back, _ = load_model(tmp_path / "double.eqx")  # what was saved in double loads in single precision
    assert eqx.tree_equal(back, model_of(kind))


@pytest.mark.parametrize("kind", KINDS)
def test_a_model_and_its_derivatives_pass_under_strict_rank_promotion(kind):
    model, given = model_of(kind), arguments(kind)

    def summed(model):
        return sum(leaf.sum() for leaf in jax.tree.leaves(model(*given)) if leaf.dtype != bool)

    with jax.numpy_rank_promotion("raise"):
        eqx.filter_eval_shape(model, *given)
        shared, each = (given[:1], given[1:]) if len(given) > 1 else ((), given)  # obstacles are shared
        many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), each)
        eqx.filter_eval_shape(jax.vmap(lambda *rest: model(*shared, *rest)), *many)
        if jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array)):
            eqx.filter_eval_shape(eqx.filter_grad(summed), model)


def test_frames_and_rollouts_pass_under_strict_rank_promotion():
    ensemble, member, full = (model_of(kind) for kind in ("dynamics", "member", "full_dynamics"))
    actions = jnp.stack([ACTION] * 4)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), BEFORE)
    with jax.numpy_rank_promotion("raise"):
        obstacles = arguments("full_dynamics")[0]
        for model in (ensemble, full):
            eqx.filter_eval_shape(roll_out, model, obstacles, BEFORE, actions)
        eqx.filter_eval_shape(ensemble.roll_out_members, obstacles, BEFORE, actions)
        for model in (member, full):
            eqx.filter_eval_shape(model.scaled_to, many, actions, many)
        for grippers in (1, 2):
            state = rope(points=4, grippers=grippers)
            frame = local_frame(state, jnp.ones((grippers, 3)), "centroid", "canonical")
            np.testing.assert_allclose(
                frame.vectors_out(frame.points_in(state.points)) + frame.origin[None], state.points, atol=1e-6
            )
            assert frame.heading(4).shape == (2,)
