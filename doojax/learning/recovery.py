"""Which actions freed the rope: labels and the fit of a recovery network (thesis section 2.3.6)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from doojax.actions import nothing_of, sampled
from doojax.learning.data import Trajectories
from doojax.learning.fit import shuffled
from doojax.learning.reliability import cross_entropy
from doojax.models.classifier import ClassifierConfig, DistanceClassifier
from doojax.models.protocols import Dynamics, Reliability, predicted
from doojax.models.recovery import RecoveryNetwork
from doojax.tasks.base import Task
from doojax.types import Obstacles, RopeState

SAMPLES = 32  # actions tried at a state, N_rs
AT_ONCE = 64  # states judged side by side


class RecoveryExamples(eqx.Module):
    """n actions that were taken in states where nothing was accepted."""

    state: RopeState  # [n]
    action: Float[Array, "n G 3"]  # m
    obstacles: Obstacles  # [n]
    acceptance: Float[Array, "n"]  # fraction of sampled actions that are accepted in the state after it
    trajectory: Int[Array, "n"]  # which of the `Trajectories` it is from
    time: Int[Array, "n"]  # the state's place in it

    def __len__(self) -> int:
        """n."""
        return self.acceptance.shape[0]


def acceptance(
    task: Task,
    dynamics: Dynamics,
    reliability: Reliability,
    obstacles: Obstacles,
    state: RopeState,
    *,
    key: Array,
) -> Float[Array, ""]:
    """The fraction of 32 sampled actions whose predicted outcome is accepted in one state of one scene.

    0 means stuck (equation 2.4, approximately). The state, its scene and its actions come in together: the
    released code repeats them along different axes and so mixes up the elements of a batch.
    """
    nothing = nothing_of(task.actions)

    def accepted(key: Array) -> Array:
        action = sampled(task.actions, key, state, nothing)
        return reliability(obstacles, predicted(dynamics, obstacles, state, action)).accepted

    return jax.vmap(accepted)(jax.random.split(key, SAMPLES)).mean()


@eqx.filter_jit
def acceptances(
    task: Task,
    dynamics: Dynamics,
    reliability: Reliability,
    obstacles: Obstacles,
    states: RopeState,
    *,
    key: Array,
) -> Float[Array, "K T"]:
    """`acceptance` in T states of each of K scenes."""
    count, length = states.points.shape[:2]

    def one(index: Array) -> Array:
        row, time = index // length, index % length
        scene, state = (
            jax.tree.map(lambda leaf: leaf[row], obstacles),
            jax.tree.map(lambda leaf: leaf[row, time], states),
        )
        return acceptance(task, dynamics, reliability, scene, state, key=jax.random.fold_in(key, index))

    batch = min(AT_ONCE, count * length)
    return jax.lax.map(one, jnp.arange(count * length), batch_size=batch).reshape(count, length)


def label_recovery(
    task: Task, dynamics: Dynamics, reliability: Reliability, data: Trajectories, *, key: Array
) -> RecoveryExamples:
    """The recorded actions taken where nothing is accepted, and how much is accepted after each."""
    accepted = np.asarray(acceptances(task, dynamics, reliability, data.obstacles, data.states, key=key))
    rows, times = np.nonzero(accepted[:, :-1] == 0)
    return RecoveryExamples(
        state=jax.tree.map(lambda leaf: leaf[rows, times], data.states),
        action=data.actions[rows, times],
        obstacles=jax.tree.map(lambda leaf: leaf[rows], data.obstacles),
        acceptance=jnp.asarray(accepted[rows, times + 1]),
        trajectory=jnp.asarray(rows),
        time=jnp.asarray(times),
    )


class RecoveryProblem(eqx.Module):
    """Fit a `RecoveryNetwork` to how much is accepted after each action.

    Plain cross-entropy with the fraction as a soft label: actions after which all is accepted weigh as much
    as others, where the released code's 1 / (1 - p) had to leave them out.
    """

    train: RecoveryExamples
    validation: RecoveryExamples
    encoder: DistanceClassifier  # whose weights the network begins with
    config: ClassifierConfig = eqx.field(static=True)

    def init(self, member: PyTree, *, key: Array) -> RecoveryNetwork:
        """The classifier's weights, but for a fresh head."""
        fresh = RecoveryNetwork(self.config, key=key)
        return eqx.tree_at(
            lambda model: (model.network.embed, model.network.convolutions),
            fresh,
            (self.encoder.embed, self.encoder.convolutions),
        )

    def batches(self, member: PyTree, batch_size: int, *, key: Array) -> Int[Array, "steps batch"]:
        """Examples in random order."""
        return shuffled(len(self.train), batch_size, key=key)

    def loss(self, model: RecoveryNetwork, rows: Int[Array, "batch"], member: PyTree) -> Float[Array, ""]:
        """Mean binary cross-entropy."""
        batch = jax.tree.map(lambda leaf: leaf[rows], self.train)
        return _cross_entropy(model, batch).mean()

    def validate(self, model: RecoveryNetwork, member: PyTree) -> dict[str, Float[Array, ""]]:
        """Mean binary cross-entropy."""
        return {"loss": _cross_entropy(model, self.validation).mean()}


def _cross_entropy(model: RecoveryNetwork, examples: RecoveryExamples) -> Float[Array, "n"]:
    logits = jax.vmap(model.logit)(examples.obstacles, examples.state, examples.action)
    return cross_entropy(logits, examples.acceptance)
