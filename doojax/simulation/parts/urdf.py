"""Controllers of a URDF file's joints, of which it says no more than how strong and how fast they are.

Each joint that moves gets a position controller that exerts all its effort where its target is `LEAD` ahead:
its gain is effort / `LEAD`. Its damping is critical for the inertia that the joint has to move in the file's
zero posture, links beyond it as they are there.
"""

from pathlib import Path

import mujoco
import numpy as np

from doojax.robots.urdf import JointLimits

LEAD = 0.02  # rad or m, that a target is ahead of its joint at most


def add_controllers(spec: mujoco.MjSpec, file: Path, limits: dict[str, JointLimits]) -> None:
    """Add the controllers of a URDF file's joints to what MuJoCo has read of it.

    Raises:
        ValueError: a joint lacks a limit; the message names the joint, the limit and the file.
    """
    for name, limit in limits.items():
        lacking = [
            what
            for what, there in {
                "effort": np.isfinite(limit.effort),
                "velocity": np.isfinite(limit.speed),
                "lower and upper": limit.bounded or limit.turns,
            }.items()
            if not there
        ]
        if lacking:
            raise ValueError(
                f"joint {name!r} of {file} has no limit of {' and none of '.join(lacking)}: in a scene its "
                'controller needs <limit effort="..." velocity="..." lower="..." upper="..."/>, positive '
                "efforts (N m or N) and velocities (rad/s or m/s)"
            )
    model = spec.compile()
    for name, limit in limits.items():
        joint = model.joint(name)
        gain = limit.effort / LEAD
        damping = 2 * np.sqrt(gain * float(model.dof_M0[joint.dofadr[0]]))
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=gain, kv=damping)
        actuator.forcelimited, actuator.forcerange = True, [-limit.effort, limit.effort]
        if limit.bounded:
            actuator.ctrllimited, actuator.ctrlrange = True, list(joint.range)
