"""Learned models and simple baselines behind a few small protocols; see doojax.models.protocols."""

from doojax.models.baselines import Always as Always
from doojax.models.baselines import CollisionChecker as CollisionChecker
from doojax.models.baselines import Conjunction as Conjunction
from doojax.models.baselines import Stricter as Stricter
from doojax.models.protocols import Dynamics as Dynamics
from doojax.models.protocols import Recovery as Recovery
from doojax.models.protocols import Reliability as Reliability
