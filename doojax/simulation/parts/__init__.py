"""What scenes are made of: each part adds its bodies, is observed, and knows its addresses in the model."""

from doojax.simulation.parts.base import Frames as Frames
from doojax.simulation.parts.base import Part as Part
from doojax.simulation.parts.base import Places as Places
from doojax.simulation.parts.base import Turn as Turn
