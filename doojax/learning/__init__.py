"""Learning from recorded trajectories: problems, training, labels, calibration, models on disk."""

from doojax.learning.checkpoints import load_model as load_model
from doojax.learning.checkpoints import save_model as save_model
