"""A batch in parts is the batch."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.parts import in_parts, in_threads, worth_parts

SIZE = 3


def doubled(tree, keys):
    """Elements that do not know of each other; random numbers show whether each has its own key."""
    noise = jax.vmap(jax.random.uniform)(keys)
    return {"twice": 2 * tree["x"], "noise": noise}


@pytest.mark.parametrize("batch", range(SIZE, 3 * SIZE + 1))
def test_all_elements_come_back_in_their_order(batch):
    tree = {"x": jnp.arange(2.0 * batch).reshape(batch, 2)}
    keys = jax.random.split(jax.random.key(0), batch)
    found = in_parts(doubled, SIZE, tree, keys)
    expected = doubled(tree, keys)
    assert jax.tree.all(jax.tree.map(np.array_equal, found, expected))


def test_every_part_has_one_shape_and_threads_share_the_work():
    shapes, threads = [], set()
    together = threading.Barrier(2, timeout=20)

    def note(x):
        shapes.append(x.shape)
        threads.add(threading.get_ident())
        together.wait()  # would time out if the parts came one after another
        return x

    in_parts(note, SIZE, jnp.zeros(2 * SIZE - 1))
    assert shapes == [(SIZE,)] * 2
    assert len(threads) == 2


def test_a_thread_computes_in_the_callers_precision():
    with jax.enable_x64(True):
        found = in_parts(lambda x: x / 3, SIZE, jnp.ones(2 * SIZE))
        assert found.dtype == jnp.float64
        assert (found == 1 / 3).all()
    assert in_parts(lambda x: x / 3, SIZE, jnp.ones(2 * SIZE)).dtype == jnp.float32


@pytest.mark.slow
def test_what_goes_wrong_in_a_part_goes_wrong():
    def fail(x):
        raise ValueError(f"{x.shape[0]} are too many")

    with pytest.raises(ValueError, match="3 are too many"):
        in_parts(fail, SIZE, jnp.zeros(7))


def test_batches_that_do_not_fit_together_are_refused():
    with pytest.raises(ValueError, match=r"lengths \[4, 5\], expected one length, of at least 3"):
        in_parts(jnp.add, SIZE, jnp.zeros(5), jnp.zeros(4))
    with pytest.raises(ValueError, match=r"lengths \[2\], expected one length, of at least 3"):
        in_parts(jnp.sin, SIZE, jnp.zeros(2))


def test_threads_are_as_many_as_asked_for():
    found = in_threads(lambda item: (item, threading.get_ident()), range(6), threads=1)
    assert [item for item, _ in found] == list(range(6))
    assert len({thread for _, thread in found}) == 1


def test_one_part_is_not_split_nor_anything_while_jax_traces():
    batch, seen = jnp.zeros(3), []
    assert worth_parts(2, batch, {"x": np.zeros(1)})
    assert not worth_parts(3, batch)
    jax.jit(lambda x: seen.append(worth_parts(2, x)))(batch)
    jax.grad(lambda x: seen.append(worth_parts(2, batch, x)) or x)(1.0)
    jax.jit(lambda: seen.append(worth_parts(2, batch)))()
    assert seen == [False] * 3
