"""Learn how far moved examples err from their transforms (thesis, Algorithm 3 gives the data)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from doojax.learning.fit import FitConfig, shuffled
from doojax.models.validity import TransformValidity, ValidityConfig

LEAST_UNIT = 1e-4  # m: what no transform changes is learned, too


def validity_fit(count: int, epochs: int) -> FitConfig:
    """How to learn from so many transforms: the thesis's batches, or all of few."""
    return FitConfig(epochs=epochs, batch_size=min(32, count))


class ValidityProblem(eqx.Module):
    """A `doojax.learning.fit.Problem`: the squared error of the error, in units of its deviation."""

    transforms: Float[Array, "N 6"]  # m, rad
    errors: Float[Array, "N"]  # m
    validation: tuple[Float[Array, "V 6"], Float[Array, "V"]]
    network: ValidityConfig = eqx.field(static=True)

    def init(self, member: object, *, key: Array) -> TransformValidity:
        """A fresh network whose units are those of the data."""
        scale = jnp.abs(self.transforms).max(0)
        unit = jnp.maximum(self.errors.std(), LEAST_UNIT)
        model = TransformValidity(self.network, key=key)
        scales = (jnp.where(scale > 0, scale, 1.0), unit)
        return eqx.tree_at(lambda model: (model.input_scale, model.output_scale), model, scales)

    def batches(self, member: object, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Each example once an epoch."""
        return shuffled(len(self.errors), batch_size, key=key)

    def loss(self, model: TransformValidity, rows: Int[Array, "batch"], member: object) -> Float[Array, ""]:
        """See the class."""
        return self._loss(model, self.transforms[rows], self.errors[rows])

    def validate(self, model: TransformValidity, member: object) -> dict[str, Float[Array, ""]]:
        """The loss, and the mean distance of predicted to true errors, m."""
        transforms, errors = self.validation
        off = jnp.abs(jax.vmap(model.error)(transforms) - errors).mean()
        return {"loss": self._loss(model, transforms, errors), "off_m": off}

    def _loss(self, model: TransformValidity, transforms: Array, errors: Array) -> Array:
        off = (jax.vmap(model.error)(transforms) - errors) / model.output_scale
        return (off**2).mean()
