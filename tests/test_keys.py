"""Streams of random numbers that have names."""

import hashlib
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doojax.keys import generator, numbered, stream

words = st.lists(st.text(min_size=1, max_size=8), min_size=1, max_size=3).map(tuple)
seeds = st.integers(0, 2**63 - 1)


def data(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


def test_a_stream_is_the_beginning_of_a_hash_that_anyone_can_work_out():
    digest = hashlib.sha256(b'[7, "collect", "start"]').digest()
    expected = (int.from_bytes(digest[:4], "little"), int.from_bytes(digest[4:8], "little"))
    assert data(stream(7, "collect", "start")) == expected


def test_a_stream_is_the_same_in_another_process():
    code = "import jax, doojax.keys as k; print(jax.random.key_data(k.stream(5, 'a', 'b')).tolist())"
    environment = {**os.environ, "PYTHONHASHSEED": "1"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert run.stdout.strip() == str(list(data(stream(5, "a", "b")))), run.stderr


@given(seeds, words, seeds, words)
def test_other_names_or_another_seed_give_another_stream(seed, names, other_seed, other_names):
    same = (seed, names) == (other_seed, other_names)
    assert (data(stream(seed, *names)) == data(stream(other_seed, *other_names))) == same


def test_names_are_not_run_together():
    assert data(stream(0, "ab", "c")) != data(stream(0, "a", "bc"))
    assert data(stream(1, "a")) != data(stream(1, "a", "a"))


def test_the_whole_seed_counts():
    keys = {data(stream(seed, "scenes")) for seed in (0, 2**31, 2**32, 2**32 + 1, 2**62, 2**63 - 1)}
    assert len(keys) == 6


def test_splitting_one_stream_never_gives_another():
    """As splitting one integer seed twice does: that is how evaluation scenes became training scenes."""
    names = ("collect", "scenes", "trials", "fit", "plan")
    children = [data(key) for name in names for key in jax.random.split(stream(0, name), 64)]
    assert len(set(children)) == len(children)


@pytest.mark.parametrize("seed", [-1, 2**63, True])
def test_seeds_out_of_range_are_refused(seed):
    with pytest.raises(ValueError, match=r"the seed is .*expected a whole number from 0 to 2\^63 - 1"):
        stream(seed, "collect")


@pytest.mark.parametrize("names", [(), ("",), ("a", "")])
def test_a_stream_without_a_name_is_refused(names):
    with pytest.raises(ValueError, match="what it is for"):
        stream(0, *names)


def test_numbered_keys_depend_on_their_own_numbers_alone():
    root = stream(0, "collect")
    keys = numbered(root, range(3, 6))
    assert [data(key) for key in keys] == [data(jax.random.fold_in(root, i)) for i in (3, 4, 5)]
    assert data(numbered(root, np.array([5]))[0]) == data(keys[2])


def test_numpy_generators_have_names_too():
    draws = [generator(2**40, name).integers(2**60) for name in ("a", "b", "a")]
    assert draws[0] == draws[2] != draws[1]


def twice(key):
    return jax.random.uniform(key) + jax.random.normal(key)


def scanned(key):
    return jax.lax.scan(lambda total, _: (total + jax.random.uniform(key), None), 0.0, length=2)[0]


def made_inside(seed):
    return twice(jax.random.key(seed))


@pytest.mark.parametrize("reuses", [twice, scanned, jax.jit(twice), jax.jit(scanned)])
def test_a_key_that_is_used_twice_is_an_error_in_all_tests(reuses):
    with pytest.raises(jax.errors.KeyReuseError):
        reuses(stream(0, "test"))


def test_so_are_those_of_a_batch():
    with pytest.raises(jax.errors.KeyReuseError):
        jax.vmap(twice)(jax.random.split(stream(0, "test"), 3))


@pytest.mark.parametrize("makes", [made_inside, jax.jit(made_inside)])
def test_so_is_one_that_is_made_where_it_is_used(makes):
    with pytest.raises(jax.errors.KeyReuseError):
        makes(3)
