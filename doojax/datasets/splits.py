"""Training, validation, calibration and test trajectories that never share a scene."""

import hashlib

import numpy as np

FRACTIONS = {
    "train": 0.7,
    "validation": 0.1,  # chooses epochs and presets
    "calibration": 0.1,  # fits temperatures, and sets thresholds that keep a promise
    "test": 0.1,  # is measured on, and chooses nothing
}


def split_by_environment(environment: np.ndarray) -> dict[str, np.ndarray]:
    """Indices of the trajectories of each split.

    Args:
        environment: integers [n], equal for trajectories that share a scene.

    Returns:
        For each of "train", "validation", "calibration" and "test", increasing indices into ``environment``.
        Together they are all of range(n), each once; no scene is in two of them. Sizes are 70, 10, 10 and
        10 % of n to within one scene's trajectories, so few scenes may leave a split empty. The scenes are
        laid out in the order of the SHA-256 of their numbers, and a scene belongs where its middle falls:
        the same scenes are split alike on every machine.
    """
    scenes, scene_of, sizes = np.unique(environment, return_inverse=True, return_counts=True)
    order = sorted(range(len(scenes)), key=lambda i: hashlib.sha256(str(int(scenes[i])).encode()).digest())
    sizes = sizes[order]
    middles = (np.cumsum(sizes) - sizes / 2) / max(1, len(environment))
    split_of_scene = np.empty(len(scenes), dtype=int)
    bounds = np.cumsum(list(FRACTIONS.values()))[:-1]
    split_of_scene[order] = np.searchsorted(bounds, middles, side="right")
    return {name: np.flatnonzero(split_of_scene[scene_of] == i) for i, name in enumerate(FRACTIONS)}
