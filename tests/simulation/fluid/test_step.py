"""The fluid's physics, small: in the plane, 120 particles, twenty steps a call that all tests share."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.benchmarks.dense_fluid import dense_step
from doojax.simulation.fluid import (
    Container,
    Fluid,
    FluidSettings,
    at_rest,
    boxes_of,
    density,
    filled,
    inside,
    step,
    still,
)

FLAT = FluidSettings(spacing=0.01, dimensions=2, viscosity=1e-3)
BASIN = Container(0.1, 0.1, 0.3)
COUNT, STEPS = 120, 20


def walls(container=BASIN, poses=None, there=True):
    """Of twenty steps, one after the other: at rest at the origin, or at given x, z and angle."""
    poses = jnp.zeros((STEPS, 3)) if poses is None else poses
    place = jnp.stack([poses[:, 0], 0 * poses[:, 0], poses[:, 1]], axis=1)
    boxes = jax.vmap(partial(boxes_of, container))(place, poses[:, 2])
    return jax.vmap(still)(replace(boxes, active=boxes.active & there))


@partial(jax.jit, static_argnums=0)
def run_twenty(settings, around, fluid):
    def one(fluid, around):
        found = step(settings, around, fluid)
        return found.fluid, found

    return jax.lax.scan(one, fluid, around)


def run(fluid, calls, around=None, settings=FLAT):
    """The fluid after so many times twenty steps, and all that was found in the last twenty."""
    around, faulty = walls() if around is None else around, False
    for call in range(calls):
        here = around(call) if callable(around) else around
        fluid, found = run_twenty(settings, here, fluid)
        faulty |= bool((found.dropped | found.too_fast | found.entered).any())
    return fluid, found, faulty


NOWHERE = walls(there=False)


@pytest.fixture(scope="module")
def column():
    fluid, found, faulty = run(at_rest(jnp.asarray(filled(BASIN, (0.0, 0.0, 0.0), COUNT, FLAT))), 20)
    assert not faulty
    return fluid, np.asarray(found.pressure).mean(0)


def test_a_column_stays_at_rest_with_its_density(column):
    fluid, _ = column
    speed = np.linalg.norm(fluid.velocities, axis=1)
    assert np.sqrt((speed**2).mean()) < 0.02
    place = np.asarray(fluid.positions)
    assert place[:, 1].max() + FLAT.radius == pytest.approx(0.12, rel=0.05)  # as high as it was poured
    within = place[:, 1] < 0.1  # the surface has less, as it must
    found = np.asarray(jax.jit(partial(density, FLAT))(jax.tree.map(lambda w: w[0], walls()), place))[within]
    assert abs(found.mean() - 1) < 0.05
    assert np.abs(found - 1).max() < 0.15


def test_pressure_is_that_of_the_depth(column):
    fluid, pressure = column
    depth = 0.12 - np.asarray(fluid.positions)[:, 1]
    slope, _ = np.polyfit(depth, pressure, 1)
    assert slope == pytest.approx(FLAT.density * FLAT.gravity, rel=0.1)


def test_momentum_is_that_of_a_free_fall_without_walls():
    """Pressed together it bursts, but its middle falls as a body."""
    place = filled(BASIN, (0.0, 0.0, 0.0), COUNT, FLAT) * 0.9
    begin = jnp.array([0.1, -0.05])
    fluid, _, faulty = run(Fluid(jnp.asarray(place), jnp.tile(begin, (COUNT, 1))), 3, NOWHERE)
    assert not faulty
    fallen = begin - jnp.array([0.0, 60 * FLAT.time_step * FLAT.gravity])
    np.testing.assert_allclose(fluid.velocities.mean(0), fallen, atol=1e-4)
    assert float(jnp.abs(fluid.velocities - fallen).max()) > 0.01  # it did burst


def test_lone_particles_fall_as_bodies_do():
    apart = np.stack([0.03 * np.arange(COUNT) - 0.9, np.ones(COUNT)], axis=1).astype(np.float32)
    fluid, _, _ = run(at_rest(jnp.asarray(apart)), 5, NOWHERE)
    time = 100 * FLAT.time_step
    np.testing.assert_allclose(fluid.velocities[:, 1], -FLAT.gravity * time, rtol=1e-3)
    np.testing.assert_allclose(fluid.positions[:, 1], 1 - FLAT.gravity * time**2 / 2, atol=0.01)


def test_viscosity_is_that_asked_for():
    """Of a velocity (10 z^2, 0), of Laplacian 20, the viscous acceleration is 20 times the viscosity."""
    across, up = (np.arange(10) - 4.5) * FLAT.spacing, (np.arange(12) - 5.5) * FLAT.spacing
    grid = np.stack(np.meshgrid(across, up, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float32)
    flow = np.stack([10 * grid[:, 1] ** 2, np.zeros(COUNT, np.float32)], axis=1)
    _, found = run_twenty(FLAT, NOWHERE, Fluid(jnp.asarray(grid), jnp.asarray(flow)))
    middle = (np.abs(grid) < 0.026).all(1)
    gained = np.asarray(found.fluid.velocities)[0, middle, 0] - flow[middle, 0]
    assert gained.mean() / FLAT.time_step == pytest.approx(20 * FLAT.viscosity, rel=0.15)


@pytest.mark.slow  # another viscosity is compiled anew; test_viscosity_is_that_asked_for is not
def test_a_column_that_is_let_go_spreads_slower_the_more_viscous_it_is():
    wide, dam = Container(0.5, 0.1, 0.2), Container(0.06, 0.1, 0.25)
    place = jnp.asarray(filled(dam, (-0.22, 0.0, 0.0), COUNT, FLAT))
    fronts = []
    for viscosity in (1e-4, FLAT.viscosity):  # the bench has more of them
        settings = replace(FLAT, viscosity=viscosity)
        fluid, _, faulty = run(at_rest(place), 3, walls(wide), settings)
        assert not faulty
        fronts.append(float(fluid.positions[:, 0].max()) + 0.25)
    assert fronts[0] > fronts[1] + 0.01


@pytest.mark.parametrize("seed", range(3))
def test_nothing_gets_through_walls_that_shake_and_turn(seed):
    rng = np.random.default_rng(seed)
    cup = Container(0.1, 0.1, 0.15)
    phases = rng.uniform(0, 6, 3)
    amounts = rng.uniform(0.5, 1.0, 3) * [0.05, 0.05, 0.4]

    def poses(call):
        time = (np.arange(STEPS) + 1 + STEPS * call)[:, None] * FLAT.time_step
        return jnp.asarray(amounts * (np.sin(8 * time + phases) - np.sin(phases)), jnp.float32)

    begin = at_rest(jnp.asarray(filled(cup, (0.0, 0.0, 0.0), COUNT, FLAT)))
    fluid, _, faulty = run(begin, 15, lambda call: walls(cup, poses(call)))
    assert not faulty
    x, z, angle = poses(14)[-1]
    taller = replace(cup, height=2.0)  # what jumped out above is in the room over it
    assert bool(inside(taller, jnp.stack([x, 0 * x, z]), angle, fluid.positions).mean() > 0.95)


def test_the_same_start_gives_the_same_bytes(column):
    again, _, _ = run(at_rest(jnp.asarray(filled(BASIN, (0.0, 0.0, 0.0), COUNT, FLAT))), 20)
    assert again.positions.tobytes() == column[0].positions.tobytes()


def falling_block(settings, count):
    place = filled(Container(0.09, 0.05, 0.2), (0.0, 0.0, 0.001), count, settings)
    return Fluid(jnp.asarray(place), jnp.full(place.shape, -0.3))


@pytest.mark.slow
def test_steps_are_those_by_all_pairs():
    """A second implementation without lists, of a block that falls into a corner."""
    begin, around = falling_block(FLAT, COUNT), walls()
    _, found = run_twenty(FLAT, around, begin)
    other = jax.jit(partial(dense_step, FLAT))
    for number in range(5):
        begin = other(jax.tree.map(lambda leaf, n=number: leaf[n], around), begin)
    np.testing.assert_allclose(found.fluid.positions[4], begin.positions, atol=1e-5)
    np.testing.assert_allclose(found.fluid.velocities[4], begin.velocities, atol=3e-3)
    assert float(jnp.abs(begin.velocities).max()) > 0.1


@pytest.mark.slow
def test_steps_in_space_are_those_by_all_pairs():
    settings = replace(FLAT, dimensions=3)
    ours = theirs = falling_block(settings, 200)
    around = jax.tree.map(lambda leaf: leaf[0], walls())
    one, other = jax.jit(partial(step, settings, around)), jax.jit(partial(dense_step, settings, around))
    for _ in range(5):
        ours, theirs = one(ours).fluid, other(theirs)
    np.testing.assert_allclose(ours.positions, theirs.positions, atol=1e-5)
    np.testing.assert_allclose(ours.velocities, theirs.velocities, atol=3e-3)


def test_what_is_no_number_is_told():
    place = jnp.asarray(filled(BASIN, (0.0, 0.0, 0.0), COUNT, FLAT)).at[3, 0].set(jnp.nan)
    fluid, _ = run_twenty(FLAT, walls(), at_rest(place))
    assert not np.isfinite(fluid.positions).all()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"spacing": 0.0}, r"spacing is 0\.0, expected a positive number"),
        ({"viscosity": -1.0}, r"viscosity is -1\.0, expected at least 0"),
        (
            {"viscosity": 1.0},
            r"1\.0 m\^2/s is too large for time steps of 0\.0025 s: expected at most",
        ),
        ({"iterations": 0}, "iterations is 0"),
    ],
)
def test_settings_without_a_meaning_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        replace(FLAT, **given)


def test_a_step_too_long_for_the_speed_is_refused_before_and_told_after():
    with pytest.raises(ValueError, match=r"steps of 0\.0025 s are too long: at 20 m/s .* expected at most"):
        FLAT.require_speed(20.0, 0.02)
    FLAT.require_speed(3.0, 0.02)
    place = jnp.asarray(filled(BASIN, (0.0, 0.0, 0.0), COUNT, FLAT))
    fast = jnp.zeros(place.shape).at[-1, 1].set(20.0)
    assert bool(run_twenty(FLAT, walls(), Fluid(place, fast))[1].too_fast[0])
    assert not bool(run_twenty(FLAT, walls(), at_rest(place))[1].too_fast[0])
