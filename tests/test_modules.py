"""`jax.jit` of modules and of their methods: as they are, compiled once, never out of date."""

import gc
import inspect
import weakref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.modules import Jittable

TRACES = []


class Line(Jittable):
    slope: jax.Array
    network: eqx.nn.Linear | None = None

    def __call__(self, x):
        TRACES.append("call")
        return self.slope * x

    def shifted(self, x, *, by=1.0):
        """Shifted up."""
        TRACES.append("shifted")
        return self.slope * x + by

    def squared(self, x):
        return self.slope * x**2

    @eqx.filter_jit
    def compiled(self, x):
        return self.slope - x

    @staticmethod
    def name():
        return "line"

    @classmethod
    def flat(cls):
        return cls(jnp.zeros(()))


def line(slope: float) -> Line:
    return Line(jnp.asarray(slope), eqx.nn.Linear(2, 2, key=jax.random.key(0)))


def test_a_module_and_its_methods_are_jitted_as_they_are():
    two = line(2.0)
    assert jax.jit(two)(3.0) == 6
    assert jax.jit(two.shifted)(3.0) == 7
    assert jax.jit(two.shifted, static_argnames="by")(3.0, by=4) == 10
    assert jax.jit(two.compiled)(3.0) == two.compiled(3.0) == -1
    assert (two.name(), Line.flat()(1.0)) == ("line", 0)
    assert jax.grad(two.squared)(3.0) == 12
    np.testing.assert_array_equal(jax.vmap(two.shifted)(jnp.arange(3.0)), [1, 3, 5])


def test_one_instance_is_compiled_once_and_another_anew():
    two = line(2.0)
    TRACES.clear()
    methods = two.shifted, two.shifted
    for x, shifted in zip((1.0, 2.0), methods, strict=True):
        assert jax.jit(two)(x) == 2 * x and jax.jit(shifted)(x) == 2 * x + 1
    assert TRACES == ["call", "shifted"]
    three = eqx.tree_at(lambda module: module.slope, two, jnp.array(3.0))
    assert jax.jit(three)(1.0) == 3 and jax.jit(three.shifted)(1.0) == 4
    assert jax.jit(two)(1.0) == 2 and jax.jit(two.shifted)(1.0) == 3
    assert TRACES == ["call", "shifted"] * 2


def test_only_the_same_instance_and_method_are_equal():
    two, twin = line(2.0), line(2.0)
    assert two == two and two != twin and eqx.tree_equal(two, twin)
    assert two.shifted == two.shifted and hash(two.shifted) == hash(two.shifted)
    assert two.shifted != two.squared and two.shifted != twin.shifted
    assert len({two, twin, two.shifted, two.shifted, two.squared, two.compiled, two.compiled}) == 5


def test_inside_of_another_jit_derivatives_and_new_values_go_through():
    @jax.jit
    def twice(slope, x):
        changed = eqx.tree_at(lambda module: module.slope, line(0.0), slope)
        return jax.jit(changed)(x) + jax.jit(changed.shifted)(x) + jax.jit(changed.shifted)(x)

    assert twice(2.0, 3.0) == 20 and twice(4.0, 3.0) == 38
    assert jax.grad(twice)(2.0, 3.0) == 9
    np.testing.assert_array_equal(jax.vmap(twice, (0, None))(jnp.array([2.0, 4.0]), 3.0), [20, 38])


def test_methods_are_pytrees_and_show_their_arguments_and_documentation():
    two = line(2.0)
    doubled = jax.tree.map(lambda leaf: 2 * leaf, two.shifted)
    assert doubled(3.0) == 13
    assert len(jax.tree.leaves(two.shifted)) == 3
    assert str(inspect.signature(two.shifted)) == "(x, *, by=1.0)"
    assert str(inspect.signature(two.compiled)) == "(x)"
    assert two.shifted.__doc__ == "Shifted up." and two.shifted.__name__ == "shifted"


def test_what_was_jitted_is_not_kept_alive():
    two = line(2.0)
    jax.jit(two)(1.0), jax.jit(two.shifted)(1.0)
    alive = weakref.ref(two)
    del two
    gc.collect()
    assert alive() is None


def test_instances_stay_immutable():
    with pytest.raises(AttributeError, match="cannot assign"):
        line(2.0).slope = jnp.array(3.0)
