"""Data sets for other libraries: what trajectories are as episodes, and the layouts of LeRobot and Minari."""

from doojax.datasets.exports.episodes import Episodes as Episodes
from doojax.datasets.exports.episodes import episodes_of as episodes_of
