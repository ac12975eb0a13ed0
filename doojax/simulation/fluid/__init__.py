"""A fluid of particles in containers that move: position-based (Macklin and Mueller 2013), in pure JAX.

`FluidSettings` say what the fluid is, `filled` puts particles into a container, `step` advances them,
`inside` says which are in a container. All are functions of one element, to be batched by `jax.vmap`.
"""

from doojax.simulation.fluid.containers import Container as Container
from doojax.simulation.fluid.containers import boxes_of as boxes_of
from doojax.simulation.fluid.containers import filled as filled
from doojax.simulation.fluid.containers import inside as inside
from doojax.simulation.fluid.settings import FluidSettings as FluidSettings
from doojax.simulation.fluid.step import Fluid as Fluid
from doojax.simulation.fluid.step import Stepped as Stepped
from doojax.simulation.fluid.step import at_rest as at_rest
from doojax.simulation.fluid.step import density as density
from doojax.simulation.fluid.step import step as step
from doojax.simulation.fluid.walls import Walls as Walls
from doojax.simulation.fluid.walls import still as still
