"""How each kind of model is built and trained: `quick` on two CPU cores, `thesis` as the thesis did."""

from dataclasses import dataclass
from typing import Any, Literal

from doojax.learning.fit import FitConfig
from doojax.learning.labels import THESIS, LabelConfig
from doojax.models.classifier import ClassifierConfig, DistanceClassifier
from doojax.models.dynamics import DynamicsConfig
from doojax.models.full_dynamics import FullDynamicsConfig
from doojax.models.local import Origin
from doojax.models.pouring import PouringConfig, PouringJudgeConfig
from doojax.models.rasters import view
from doojax.models.voxel_classifier import VoxelClassifierConfig
from doojax.simulation.rope import FRICTION_DIRECTIONS
from doojax.tasks.base import Task
from doojax.types import PouringState

PresetName = Literal["quick", "thesis"]


@dataclass(frozen=True)
class Preset:
    """A network's config, and how it is fitted."""

    network: Any
    fit: FitConfig


def dynamics_preset(name: PresetName, task: Task) -> Preset:
    """`quick`: smaller networks, canonical frames, inputs scaled to unit variance; `thesis`: none of it."""
    if isinstance(task.blank, PouringState):
        thesis = name == "thesis"
        network = PouringConfig(width=1024, depth=4) if thesis else PouringConfig()
        return Preset(network, FitConfig(epochs=120, batch_size=32, members=4, learning_rate=1e-3))
    size = {"points": task.scene.links, "grippers": task.grippers, "origin": origin(task)}
    if name == "thesis":
        return Preset(
            DynamicsConfig(**size), FitConfig(epochs=400, batch_size=16, members=8, schedule="constant")
        )
    planar = task.scene.planar  # narrower networks do as well there
    config = DynamicsConfig(
        **size,
        width=128 if planar else 256,
        symmetry="canonical",
        heading_fold=2 * FRICTION_DIRECTIONS if planar else 0,
    )
    epochs = 240 if planar else 120
    return Preset(config, FitConfig(epochs=epochs, batch_size=32, members=4, learning_rate=2e-3))


def classifier_preset(name: PresetName, task: Task) -> Preset:
    """The classifier from distances; `thesis` is wider and trained longer, `quick` small for flat ropes."""
    if name == "thesis":
        return Preset(
            ClassifierConfig(task.grippers, origin(task), width=128), FitConfig(epochs=40, batch_size=128)
        )
    if task.scene.planar:
        config = ClassifierConfig(task.grippers, origin(task), width=32, midpoints=False)
    else:
        config = ClassifierConfig(task.grippers, origin(task))
    return Preset(config, FitConfig(epochs=15, batch_size=128))


def voxel_classifier_preset(name: PresetName, task: Task) -> Preset:
    """The thesis's classifier from voxels; `quick` has coarser voxels and fewer channels."""
    config = VoxelClassifierConfig(task.scene.links, view(name, task.grippers))
    return Preset(config, FitConfig(epochs=10 if name == "thesis" else 3, batch_size=16))


def deviation_preset(name: PresetName, task: Task) -> Preset:
    """The network of the classifier from distances; `thesis` trains as its released code does."""
    if isinstance(task.blank, PouringState):
        return Preset(PouringJudgeConfig(), FitConfig(epochs=30, batch_size=64, learning_rate=1e-3))
    network = classifier_preset(name, task).network
    if name == "thesis":
        fit = FitConfig(epochs=10, batch_size=32, learning_rate=5e-4, schedule="constant")
        return Preset(network, fit)
    return Preset(network, FitConfig(epochs=10, batch_size=128))


def full_dynamics_preset(name: PresetName, task: Task) -> Preset:
    """The baseline that predicts motion among obstacles; `quick` has coarser voxels and fewer channels."""
    config = FullDynamicsConfig(task.scene.links, view(name, task.grippers))
    return Preset(config, FitConfig(epochs=50 if name == "thesis" else 3, batch_size=8))


def recovery_preset(name: PresetName, classifier: DistanceClassifier) -> Preset:
    """As the classifier whose encoder it begins with."""
    return Preset(classifier.config, FitConfig(epochs=40 if name == "thesis" else 20, batch_size=64))


def labels_preset(name: PresetName) -> LabelConfig:
    """`quick`: from every fifth state for ten steps, as a planner does; `thesis`: once a trajectory."""
    return THESIS if name == "thesis" else LabelConfig()


def origin(task: Task) -> Origin:
    """Of the local frame: the gripper, or with two of them the rope's mean point."""
    return "gripper" if task.grippers == 1 else "centroid"
