"""How each kind of model is built from the config in its file's header.

All raise ValueError for a config that is not as it has to be, saying where.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array

from doojax.keys import stream
from doojax.models.classifier import ClassifierConfig, DistanceClassifier
from doojax.models.deviation import DeviationEstimator
from doojax.models.dynamics import DynamicsConfig, UnconstrainedDynamics
from doojax.models.ensemble import Ensemble
from doojax.models.full_dynamics import FullDynamics, FullDynamicsConfig
from doojax.models.policy import Policy, PolicyConfig
from doojax.models.pouring import PouringConfig, PouringDynamics, PouringJudgeConfig
from doojax.models.recovery import RecoveryNetwork
from doojax.models.validity import TransformValidity, ValidityConfig
from doojax.models.voxel_classifier import VoxelClassifier, VoxelClassifierConfig
from doojax.reading import checked
from doojax.types import Size


@dataclass(frozen=True)
class Members:
    """How many networks an ensemble has."""

    members: Size


def dynamics(config: Mapping[str, Any]) -> Ensemble:
    """An `Ensemble`; config: members, and the fields of `DynamicsConfig` or `PouringConfig`."""
    members = checked({"members": config.get("members")}, Members).members
    about: type = PouringConfig if config.get("what") == "pouring" else DynamicsConfig
    network = checked({name: config[name] for name in config if name != "members"}, about)
    keys = jax.random.split(stream(0, "structure"), members)
    return Ensemble(eqx.filter_vmap(lambda key: dynamics_network(network, key=key))(keys))


def dynamics_network(config: DynamicsConfig | PouringConfig, *, key: Array) -> Any:
    """A fresh network of the kind that a config is for."""
    if isinstance(config, PouringConfig):
        return PouringDynamics(config, key=key)
    return UnconstrainedDynamics(config, key=key)


def classifier(config: Mapping[str, Any]) -> DistanceClassifier:
    """A `DistanceClassifier`; config: the fields of `ClassifierConfig`."""
    return DistanceClassifier(checked(config, ClassifierConfig), key=stream(0, "structure"))


def recovery(config: Mapping[str, Any]) -> RecoveryNetwork:
    """A `RecoveryNetwork`; config: the fields of `ClassifierConfig`."""
    return RecoveryNetwork(checked(config, ClassifierConfig), key=stream(0, "structure"))


def deviation(config: Mapping[str, Any]) -> DeviationEstimator:
    """A `DeviationEstimator`; config: the fields of `ClassifierConfig` or `PouringJudgeConfig`."""
    about: type = PouringJudgeConfig if config.get("what") == "pouring" else ClassifierConfig
    return DeviationEstimator(checked(config, about), key=stream(0, "structure"))


def full_dynamics(config: Mapping[str, Any]) -> FullDynamics:
    """A `FullDynamics`; config: the fields of `FullDynamicsConfig`, those of its view in a dict."""
    return FullDynamics(checked(config, FullDynamicsConfig), key=stream(0, "structure"))


def voxel_classifier(config: Mapping[str, Any]) -> VoxelClassifier:
    """A `VoxelClassifier`; config: the fields of `VoxelClassifierConfig`, those of its view in a dict."""
    return VoxelClassifier(checked(config, VoxelClassifierConfig), key=stream(0, "structure"))


def policy(config: Mapping[str, Any]) -> Policy:
    """A `Policy`; config: the fields of `PolicyConfig`."""
    return Policy(checked(config, PolicyConfig), key=stream(0, "structure"))


def validity(config: Mapping[str, Any]) -> TransformValidity:
    """A `TransformValidity`; config: the fields of `ValidityConfig`."""
    return TransformValidity(checked(config, ValidityConfig), key=stream(0, "structure"))


BUILDERS: Mapping[str, Callable[[dict[str, Any]], Any]] = {
    "dynamics": dynamics,
    "classifier": classifier,
    "recovery": recovery,
    "deviation": deviation,
    "full_dynamics": full_dynamics,
    "policy": policy,
    "validity": validity,
    "voxel_classifier": voxel_classifier,
}
