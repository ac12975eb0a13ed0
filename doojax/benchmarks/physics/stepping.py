"""MuJoCo C step by step, for what no simulator of doojax reports: forces, and loads put on a rope."""

from collections.abc import Callable

import mujoco
import numpy as np
from jaxtyping import Float

from doojax.simulation.build import build_model
from doojax.simulation.layout import Layout
from doojax.simulation.rope import link_name
from doojax.simulation.scenes import Scene


class Stepper:
    """One scene at one state; obstacles stand where ``obstacles`` says, by name: position (m), quaternion."""

    def __init__(
        self,
        scene: Scene,
        qpos: Float[np.ndarray, "nq"],
        obstacles: dict[str, tuple[np.ndarray, np.ndarray]] | None = None,
    ):
        """Every hand holds, at rest, and is sent to where it is."""
        self.scene, self.model = scene, build_model(scene)
        self.layout, self.data = Layout.of(scene, self.model), mujoco.MjData(self.model)
        self.data.qpos[:] = qpos
        for name, (position, quaternion) in (obstacles or {}).items():
            mocap = self.model.body(name).mocapid[0]
            self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = position, quaternion
        self.home = self.data.qpos[self.layout.driven].copy()
        self.data.ctrl[:] = self.home.reshape(-1)
        mujoco.mj_forward(self.model, self.data)

    def steps(
        self, seconds: float, targets: Callable[[float], Float[np.ndarray, "G D"]] | None = None
    ) -> "list[Sample]":
        """Go on for so long, or until the rope bursts, hands sent to ``targets(time)``, or left alone.

        One sample each step.
        """
        samples = []
        for _ in range(round(seconds / self.scene.timestep)):
            if targets is not None:
                self.data.ctrl[:] = targets(self.data.time).reshape(-1)
            mujoco.mj_step(self.model, self.data)
            samples.append(Sample(self))
            if not np.isfinite(self.data.qpos).all():
                break
        return samples

    def twist(self, link: int, torque: float) -> None:
        """Put a torque (N m, about the world's x axis) on a link, from now on."""
        self.data.xfrc_applied[self.model.body(link_name(link)).id, 3] = torque

    def roll(self, link: int) -> float:
        """By what angle (rad) a link that lies along x has turned about it."""
        matrix = self.data.body(link_name(link)).xmat.reshape(3, 3)
        return float(np.arctan2(matrix[2, 1], matrix[1, 1]))


class Sample:
    """What is read off after a step."""

    def __init__(self, stepper: Stepper):
        """Copy it out of the simulation."""
        shape = stepper.home.shape
        self.time = stepper.data.time
        self.force = stepper.data.actuator_force[: stepper.home.size].reshape(shape).copy()  # N, on the hands
        self.hands = stepper.data.qpos[stepper.layout.driven].copy()  # m
        self.points = stepper.data.xpos[stepper.layout.links].copy()  # m


def mean_force(samples: list[Sample], since: float, hand: int, axis: int) -> float:
    """Of a hand along a world axis (N) from ``since`` (s) on; NaN for a rope that burst."""
    if not np.isfinite(samples[-1].points).all():
        return float("nan")
    return float(np.mean([sample.force[hand, axis] for sample in samples if sample.time > since]))
