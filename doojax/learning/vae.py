"""Learn a variational autoencoder of pushing, and make other trajectories with it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from doojax.keys import stream
from doojax.learning.fit import Progress
from doojax.learning.pushing import PushingData
from doojax.models.vae import Vae, VaeConfig

UNITS = (0.05, 0.003)  # m, of places and of motions, so that both are numbers of about one


class VaeProblem(eqx.Module):
    """A `doojax.learning.fit.Problem`; a member is (first, count), which trajectories are its own."""

    train: PushingData
    validation: PushingData
    step: Int[Array, ""]  # of the optimiser: each has noise of its own
    network: VaeConfig = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    def init(self, member: tuple[Int[Array, ""], Int[Array, ""]], *, key: Array) -> Vae:
        """A fresh network."""
        return Vae(self.network, key=key)

    def batches(
        self, member: tuple[Int[Array, ""], Int[Array, ""]], batch_size: int, *, key: Array
    ) -> Int[Array, "steps batch"]:
        """Rows of the member's own trajectories, drawn with replacement."""
        first, count = member
        return first + jax.random.randint(key, (self.steps, batch_size), 0, count)

    def loss(self, model: Vae, rows: Int[Array, "batch"], member: object) -> Float[Array, ""]:
        """The negative evidence lower bound."""
        x = jax.vmap(flat)(self.train.places[rows], self.train.moves[rows])
        keys = jax.random.split(jax.random.fold_in(stream(0, "vae noise"), self.step), len(rows))
        return jax.vmap(model.loss)(x, keys).mean()

    def after(self, progress: Progress) -> "VaeProblem":
        """The same, with the next step's noise."""
        return VaeProblem(self.train, self.validation, progress.steps, self.network, self.steps)

    def validate(self, model: Vae, member: object) -> dict[str, Float[Array, ""]]:
        """The same, of trajectories that it has not seen."""
        x = jax.vmap(flat)(self.validation.places, self.validation.moves)
        keys = jax.random.split(stream(0, "vae validation"), len(x))
        return {"loss": jax.vmap(model.loss)(x, keys).mean()}


def flat(places: Float[Array, "T1 B 2"], moves: Float[Array, "T B 2"]) -> Float[Array, "i"]:
    """A trajectory as numbers of about one."""
    return jnp.concatenate([places.ravel() / UNITS[0], moves.ravel() / UNITS[1]])


def size_of(data: PushingData) -> int:
    """How many numbers a trajectory is."""
    return data.places[0].size + data.moves[0].size


@eqx.filter_jit
def varied(model: Vae, data: PushingData, keys: Key[Array, "K"]) -> PushingData:
    """One other trajectory for each of K; its motions are the decoder's, not its places' differences."""

    def one(places: Array, moves: Array, key: Array) -> tuple[Array, Array]:
        made = model.varied(flat(places, moves), key)
        there, ways = made[: places.size], made[places.size :]
        return UNITS[0] * there.reshape(places.shape), UNITS[1] * ways.reshape(moves.shape)

    return PushingData(*jax.vmap(one)(data.places, data.moves, keys))
