"""How each kind of model is built from the config in its file's header."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax

from doojax.keys import stream
from doojax.models.classifier import ClassifierConfig, DistanceClassifier
from doojax.models.dynamics import DynamicsConfig, UnconstrainedDynamics
from doojax.models.ensemble import Ensemble
from doojax.models.full_dynamics import FullDynamics, FullDynamicsConfig
from doojax.models.rasters import ViewConfig
from doojax.models.recovery import RecoveryNetwork
from doojax.models.voxel_classifier import VoxelClassifier, VoxelClassifierConfig


def dynamics(config: Mapping[str, Any]) -> Ensemble:
    """An `Ensemble`; config: members, and the fields of `DynamicsConfig`."""
    network = DynamicsConfig(**{name: value for name, value in config.items() if name != "members"})
    keys = jax.random.split(stream(0, "structure"), config["members"])
    return Ensemble(eqx.filter_vmap(lambda key: UnconstrainedDynamics(network, key=key))(keys))


def classifier(config: Mapping[str, Any]) -> DistanceClassifier:
    """A `DistanceClassifier`; config: the fields of `ClassifierConfig`."""
    return DistanceClassifier(ClassifierConfig(**config), key=stream(0, "structure"))


def recovery(config: Mapping[str, Any]) -> RecoveryNetwork:
    """A `RecoveryNetwork`; config: the fields of `ClassifierConfig`."""
    return RecoveryNetwork(ClassifierConfig(**config), key=stream(0, "structure"))


def full_dynamics(config: Mapping[str, Any]) -> FullDynamics:
    """A `FullDynamics`; config: the fields of `FullDynamicsConfig`, those of its view in a dict."""
    network = FullDynamicsConfig(**{**config, "view": ViewConfig(**config["view"])})
    return FullDynamics(network, key=stream(0, "structure"))


def voxel_classifier(config: Mapping[str, Any]) -> VoxelClassifier:
    """A `VoxelClassifier`; config: the fields of `VoxelClassifierConfig`, those of its view in a dict."""
    network = VoxelClassifierConfig(**{**config, "view": ViewConfig(**config["view"])})
    return VoxelClassifier(network, key=stream(0, "structure"))


BUILDERS: Mapping[str, Callable[[dict[str, Any]], Any]] = {
    "dynamics": dynamics,
    "classifier": classifier,
    "recovery": recovery,
    "full_dynamics": full_dynamics,
    "voxel_classifier": voxel_classifier,
}
