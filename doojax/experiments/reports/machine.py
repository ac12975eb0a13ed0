"""What a figure was measured with: versions and device of this process."""

import platform
import re
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import doojax
from doojax.experiments.reports.rows import Run

# What a version is called in a file -> the package that has it.
PACKAGES = {
    "jax": "jax",
    "jaxlib": "jaxlib",
    "mujoco": "mujoco",
    "mujoco-mjx": "mujoco-mjx",
    "numpy": "numpy",
    "warp": "warp-lang",
}


def this_run() -> Run:
    """Versions and device of this process, and the date, of a command without a name."""
    return Run("", None, versions(), device(), datetime.now(UTC).isoformat(timespec="seconds"))


def versions() -> dict[str, str]:
    """The versions of Python, doojax and the installed packages that a figure may depend on."""
    found = {"python": platform.python_version(), "doojax": doojax.__version__}
    for name, package in PACKAGES.items():
        try:
            found[name] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def device() -> str:
    """What this process computes on: the GPU that JAX uses, if any, and the CPU with its usable cores."""
    import jax  # here, because reading a summary needs no JAX

    from doojax.parts import processors

    cores = processors()
    try:
        models = re.findall(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        models = []
    model = models[0] if models else platform.processor() or platform.machine()
    cpu = f"{model}, {cores} {'core' if cores == 1 else 'cores'}"
    return f"{jax.devices()[0].device_kind}; {cpu}" if jax.default_backend() == "gpu" else cpu
