"""The engines that run a scene, chosen by name."""

import importlib.util
from typing import TYPE_CHECKING

from doojax.simulation.scenes import Scene
from doojax.simulation.state import Simulator, Start

if TYPE_CHECKING:
    from doojax.simulation.engines.mjx import MjxSimulator as MjxSimulator
    from doojax.simulation.engines.mujoco import MujocoSimulator as MujocoSimulator

ENGINES = ("auto", "mujoco", "mjx", "warp")


def available_engines() -> tuple[str, ...]:
    """The engines that this machine can run, ``auto`` left out."""
    return ("mujoco", "mjx", "warp") if importlib.util.find_spec("warp") else ("mujoco", "mjx")


def resolve_engine(engine: str) -> str:
    """The engine that ``engine`` stands for: ``auto`` is mjx on an accelerator and mujoco on a CPU.

    Raises:
        ValueError: for an unknown engine.
        ModuleNotFoundError: for ``warp`` where the package warp-lang is missing.
    """
    if engine not in ENGINES:
        raise ValueError(f"unknown engine {engine!r}, expected one of {', '.join(ENGINES)}")
    if engine == "auto":
        import jax

        return "mujoco" if jax.default_backend() == "cpu" else "mjx"
    if engine not in available_engines():
        raise ModuleNotFoundError("engine 'warp' needs the package warp-lang: pip install 'doojax[warp]'")
    return engine


def make_simulator(scene: Scene, start: Start, engine: str = "auto") -> Simulator:
    """``scene`` on an engine: mujoco (C, threads), mjx, warp (MJX's NVIDIA implementation) or auto.

    Raises what `resolve_engine` raises.
    """
    engine = resolve_engine(engine)
    if engine == "mujoco":
        from doojax.simulation.engines.mujoco import MujocoSimulator

        return MujocoSimulator(scene, start)
    from doojax.simulation.engines.mjx import MjxSimulator

    return MjxSimulator(scene, start, impl="warp" if engine == "warp" else "jax")
