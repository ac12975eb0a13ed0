"""Two small arms, which compile in a tenth of the time that the dual arm takes."""

import jax.numpy as jnp

# Two links and a tool each, 40 cm apart: shoulders that turn about z and y, elbows about y.
ARM = """
<body name="{0}_turn" pos="0 {1} 0"><joint name="{0}_yaw" axis="0 0 1" range="-1.5 1.5"/>
  <geom size="0.03" fromto="0 0 0 0.1 0 0" type="capsule"/>
  <body name="{0}_upper"><joint name="{0}_pitch" axis="0 1 0" range="-1.5 1.5"/>
    <geom size="0.03" fromto="0.05 0 0 0.4 0 0" type="capsule"/>
    <body name="{0}_lower" pos="0.4 0 0"><joint name="{0}_elbow" axis="0 1 0" range="0 2.6"/>
      <geom size="0.025" fromto="0.05 0 0 0.35 0 0" type="capsule"/><site name="{0}" pos="0.4 0 0"/>
</body></body></body>
"""
SMALL = "<mujoco><compiler angle='radian' autolimits='true'/><worldbody>{}</worldbody></mujoco>".format(
    ARM.format("left", 0.2) + ARM.format("right", -0.2)
)
STARTS = jnp.array([[0.0, 0.3, 0.6] * 2, [0.0, -0.7, 1.4] * 2])  # rad, from which joints are looked for
