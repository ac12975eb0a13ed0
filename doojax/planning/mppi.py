"""Model predictive path integral control (Williams et al. 2017): a better plan from many that were tried.

Controls are drawn around the nominal ones, every sample is rolled out and priced, and the nominal controls
become the mean of the samples, weighted by exp(-cost / temperature). That needs no derivatives. Control by it
improves the nominal controls, executes the first of them, and begins again with the others:

    nominal, report = controller(nominal, state, key)
    control, nominal = nominal.controls[0], nominal.advanced()
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from doojax.geometry.frames import exact_product
from doojax.modules import Jittable
from doojax.parts import traced
from doojax.planning.risk import Risk

MOST = {"samples": 1_000_000, "horizon": 10_000}  # beyond these, arrays would not fit into any memory

type Term = Callable[[Any, Float[Array, "H U"]], Float[Array, ""]]
"""Prices a trajectory by its H states, each after its control, and its controls. The state before the first
control costs all samples the same, so it does not count."""


@dataclass(frozen=True)
class MppiSettings:
    """How controls are drawn and weighted. Controls are in units of their own, whatever those are."""

    samples: int = 128
    horizon: int = 20  # controls in a plan
    temperature: float = 1.0  # the cost by which a sample must be worse to count 1/e of a better one
    noise: float | tuple[float, ...] = 1.0  # standard deviation, of all controls or of each
    knots: int = 0  # draws along the horizon, between which noise goes on evenly; 0: each control has its own
    adapt_noise: bool = False  # the variance of each control follows that of the weighted samples
    duration: float = 0.1  # s, of each control; what the first plan expects, if durations vary
    duration_noise: float = 0.0  # s, standard deviation; every sample has one duration for all its controls
    duration_range: tuple[float, float] = (0.0, 1e3)  # s

    def __post_init__(self):
        """Refuse what controls nothing."""
        for name, most in MOST.items():
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 1 to {most:,}")
        if not 0 <= self.knots <= self.horizon:
            raise ValueError(f"knots is {self.knots}, expected 0 to the horizon, {self.horizon}")
        noise = self.noise if isinstance(self.noise, tuple) else (self.noise,)
        for name, values in {"temperature": (self.temperature,), "noise": noise}.items():
            if not values or not all(0 < value < float("inf") for value in values):
                raise ValueError(f"{name} is {getattr(self, name)}, expected positive numbers")
        low, high = self.duration_range
        if not 0 <= low <= self.duration <= high or not 0 < self.duration < float("inf"):
            raise ValueError(
                f"duration is {self.duration} s, expected a positive one in duration_range, {low} to {high} s"
            )
        if not 0 <= self.duration_noise < float("inf"):
            raise ValueError(f"duration_noise is {self.duration_noise} s, expected 0 or more")


PRESETS = {
    "quick": MppiSettings(),
    # Joint velocities, rad/s. The thesis's released code gives 2 degrees as a covariance, hence the root.
    "thesis": MppiSettings(
        samples=50,
        horizon=15,
        temperature=0.15,
        noise=0.187,
        adapt_noise=True,
        duration=0.2,
        duration_noise=0.03,
        duration_range=(0.1, 0.3),
    ),
}


class Nominal(eqx.Module):
    """The plan that samples are drawn around."""

    controls: Float[Array, "*b H U"]
    deviation: Float[Array, "*b U"]  # standard deviation of what is drawn
    duration: Float[Array, "*b"]  # s, of each control

    def advanced(self) -> "Nominal":
        """What is left when the first control is executed, zeros at its end: where the next plan starts."""
        shifted = jnp.roll(self.controls, -1, axis=-2).at[..., -1, :].set(0)
        return Nominal(shifted, self.deviation, self.duration)


class Samples(eqx.Module):
    """What is tried."""

    controls: Float[Array, "*b K H U"]
    durations: Float[Array, "*b K"]  # s, of each of a sample's controls


class Report(eqx.Module):
    """What came of the samples."""

    samples: Samples
    states: Any  # [*b, K, H, ...] after each control
    terms: dict[str, Float[Array, "*b K"]]  # cost of each sample by each term; the mean of several rollouts
    costs: Float[Array, "*b K"]  # their sum, by `Mppi.risk` if there is one
    weights: Float[Array, "*b K"]  # sum to one; zero where a cost is not finite; all zero if none is

    def unpriced(self) -> dict[str, Int[Array, "*b"]]:
        """By term, how many samples it gives a cost that is not finite; they count for nothing."""
        return {name: (~jnp.isfinite(cost)).sum(-1) for name, cost in self.terms.items()}

    def check(self) -> None:
        """Raise ValueError, with the terms to blame, if no sample has a finite cost; outside of jit."""
        if bool((self.weights.sum(-1) > 0).all()):
            return
        count = self.costs.shape[-1]
        found = {name: int(number.max()) for name, number in self.unpriced().items()}
        blamed = ", ".join(f"{name} ({number} of {count})" for name, number in found.items() if number)
        raise ValueError(
            f"no sample has a finite cost; NaN or infinite by term: {blamed or 'none, their sum is'}. The "
            "plan is as it was. Start from a finite state, take smaller steps, or mend the term"
        )


@runtime_checkable
class Rollouts(Protocol):
    """Rolls out K samples from one state, inside of jit; `rolled_out` makes one of a step."""

    def __call__(self, state: Any, controls: Float[Array, "K H U"], durations: Float[Array, "K"]) -> Any:
        """The states after each control: a pytree whose leaves begin with axes [K, H]."""
        ...


@runtime_checkable
class HostRollouts(Protocol):
    """The same for simulators that run outside of jit."""

    def many(self, state: Any, controls: Float[Array, "K H U"], durations: Float[Array, "K"]) -> Any:
        """As `Rollouts`."""
        ...


def rolled_out(step: Callable[[Any, Float[Array, "U"]], Any]) -> Rollouts:
    """Rollouts of ``step(state, control) -> state``, whose time is its own; durations do not count."""
    return timed_rolled_out(lambda state, control, _: step(state, control))


def timed_rolled_out(step: Callable[[Any, Float[Array, "U"], Float[Array, ""]], Any]) -> Rollouts:
    """Rollouts of ``step(state, control, duration) -> state``, the duration in seconds."""

    def many(state: Any, controls: Float[Array, "K H U"], durations: Float[Array, "K"]) -> Any:
        def one(controls: Array, duration: Array) -> Any:
            def go_on(state: Any, control: Array) -> tuple[Any, Any]:
                after = step(state, control, duration)
                return after, after

            return jax.lax.scan(go_on, state, controls)[1]

        return jax.vmap(one)(controls, durations)

    return many


def _floats(values: Any) -> Array:
    return jnp.asarray(values, float)


class Mppi(Jittable):
    """A controller; ``jax.jit(controller)`` compiles it, and so does a user's own jit around it.

    ``rollouts`` may be any pytree that is one, such as a learned model, or `HostRollouts`. ``low`` and
    ``high`` bound the controls; they may be infinite.
    """

    rollouts: Rollouts | HostRollouts
    terms: dict[str, Term]  # by name; their sum is the cost
    low: Float[Array, "U"] = eqx.field(converter=_floats)
    high: Float[Array, "U"] = eqx.field(converter=_floats)
    settings: MppiSettings = eqx.field(static=True, default=MppiSettings())
    # given one, rollouts lead to states [K, R, H, ...], R for each sample, such as of ropes that may be meant
    risk: Risk | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        """Refuse bounds and terms that say nothing."""
        if self.low.ndim != 1 or self.low.shape != self.high.shape:
            raise ValueError(
                f"low and high have shapes {self.low.shape} and {self.high.shape}, expected one axis, of one "
                "length"
            )
        if not traced(self.low, self.high) and not bool((self.low < self.high).all()):
            raise ValueError(f"low is {self.low}, expected below high, {self.high}")
        noise = self.settings.noise
        if isinstance(noise, tuple) and len(noise) != len(self.low):
            raise ValueError(f"noise has {len(noise)} numbers for {len(self.low)} controls")
        if not self.terms:
            raise ValueError("there are no terms: the cost needs at least one")

    def start(self) -> Nominal:
        """The plan to do nothing, or what the bounds allow that is nearest to it."""
        still = jnp.clip(jnp.zeros_like(self.low), self.low, self.high)
        return Nominal(
            jnp.broadcast_to(still, (self.settings.horizon, len(self.low))),
            jnp.broadcast_to(jnp.asarray(self.settings.noise, self.low.dtype), self.low.shape),
            jnp.asarray(self.settings.duration, self.low.dtype),
        )

    def __call__(self, nominal: Nominal, state: Any, key: Key[Array, ""]) -> tuple[Nominal, Report]:
        """A better plan for the same time as ``nominal``, and how it was found.

        Args:
            nominal: `start`, or what was left of the last plan.
            state: one, as the rollouts take it; `jax.vmap` for many.
            key: for the samples.

        Raises:
            ValueError: inside of jit, for rollouts that run outside of it.
        """
        if not isinstance(self.rollouts, HostRollouts):
            samples = self.draw(nominal, key)
            return self.improved(nominal, samples, self.rollouts(state, samples.controls, samples.durations))
        if traced(nominal, state, key):
            raise ValueError(
                "these rollouts run outside of jit, but MPPI is called inside: call it outside, or use a "
                "simulator of engine='mjx'"
            )
        pure = eqx.tree_at(lambda controller: controller.rollouts, self, _nothing)
        samples = _draw(pure, nominal, key)
        return _improved(
            pure, nominal, samples, self.rollouts.many(state, samples.controls, samples.durations)
        )

    def draw(self, nominal: Nominal, key: Key[Array, ""]) -> Samples:
        """Samples around a plan, within the bounds."""
        settings = self.settings
        for_controls, for_durations = jax.random.split(key)
        shape = (settings.samples, settings.knots or settings.horizon, len(self.low))
        noise = jax.random.normal(for_controls, shape, self.low.dtype)
        if settings.knots:
            between = _between(settings.knots, settings.horizon, noise.dtype)
            noise = exact_product(jnp.broadcast_to(between, (len(noise), *between.shape)), noise)
        controls = jnp.clip(nominal.controls[None] + nominal.deviation * noise, self.low, self.high)
        if not settings.duration_noise:
            return Samples(controls, jnp.broadcast_to(nominal.duration, (settings.samples,)))
        spread = settings.duration_noise * jax.random.normal(for_durations, (settings.samples,))
        return Samples(controls, jnp.clip(nominal.duration + spread, *settings.duration_range))

    def improved(self, nominal: Nominal, samples: Samples, states: Any) -> tuple[Nominal, Report]:
        """The weighted mean of samples whose rollouts led to ``states`` [K, H, ...]."""
        every = {
            name: self._priced(term)(states, samples.controls).astype(self.low.dtype)
            for name, term in self.terms.items()
        }
        costs = sum(every.values(), jnp.zeros((), self.low.dtype))
        terms = every
        if self.risk is not None:
            costs, terms = self.risk.of(costs), {name: own.mean(-1) for name, own in every.items()}
        priced = jnp.isfinite(costs)
        exponents = jnp.where(priced, -costs / self.settings.temperature, -jnp.inf)
        weights = jnp.where(priced.any(), jax.nn.softmax(jnp.where(priced.any(), exponents, 0)), 0)

        def mean(values: Array) -> Array:  # no matrix product: see doojax.geometry.frames
            return (weights.reshape(-1, *(1,) * (values.ndim - 1)) * values).sum(0)

        controls, deviation = mean(samples.controls), nominal.deviation
        if self.settings.adapt_noise:
            deviation = jnp.sqrt(mean(((samples.controls - nominal.controls) ** 2).mean(1)))
        found = Nominal(controls, deviation, mean(samples.durations))
        kept = jax.tree.map(lambda new, old: jnp.where(priced.any(), new, old), found, nominal)
        return kept, Report(samples, states, terms, costs, weights)

    def _priced(self, term: Term) -> Term:
        """A term of all samples, and of all their rollouts if each has several."""
        return jax.vmap(term if self.risk is None else jax.vmap(term, (0, None)))


def _between(knots: int, horizon: int, dtype: Any) -> Float[Array, "H k"]:
    """What each control has of the draws at knots: of the two beside it, so that its variance is theirs."""
    place = jnp.linspace(0, knots - 1, horizon, dtype=dtype)[:, None]
    near = jnp.maximum(0, 1 - jnp.abs(place - jnp.arange(knots, dtype=dtype)))
    return near / jnp.sqrt((near**2).sum(-1, keepdims=True))


def unwound(
    commanded: Float[Array, "*b"], actual: Float[Array, "*b"], most: float = 0.02
) -> Float[Array, "*b"]:
    """A commanded position that runs at most ``most`` ahead of the actual one, as the thesis has it (rad).

    What integrates velocities to a command keeps adding to it while something holds the joint back; without
    this a joint that comes free jumps.
    """
    return actual + jnp.clip(commanded - actual, -most, most)


def _nothing(state: Any, controls: Array, durations: Array) -> Any:
    raise ValueError("no rollouts")


@eqx.filter_jit
def _draw(controller: Mppi, nominal: Nominal, key: Array) -> Samples:
    return controller.draw(nominal, key)


@eqx.filter_jit
def _improved(controller: Mppi, nominal: Nominal, samples: Samples, states: Any) -> tuple[Nominal, Report]:
    return controller.improved(nominal, samples, states)
