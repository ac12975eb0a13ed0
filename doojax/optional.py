"""Packages that a plain ``pip install doojax`` leaves out, and the extra that brings each."""

import importlib.util

EXTRAS = {  # module -> extra of doojax
    "brax": "rl",
    "flax": "bench",
    "gymnasium": "rl",
    "h5py": "export",
    "h_signature": "bench",
    "imageio": "view",
    "matplotlib": "figures",
    "mink": "bench",
    "ompl": "bench",
    "PIL": "view",
    "playwright": "dev",
    "pyarrow": "export",
    "pytorch_mppi": "bench",
    "ray": "ray",
    "submitit": "slurm",
    "torch": "bench",
    "viser": "view",
    "warp": "warp",
    "yaml": "sweep",
}


def advice(error: ModuleNotFoundError) -> str:
    """What an error says, and which extra brings the package that is missing, if one does."""
    extra = EXTRAS.get((error.name or "").split(".")[0])
    said = str(error)
    return said if extra is None or "pip install" in said else f"{said}: pip install 'doojax[{extra}]'"


def require(*modules: str) -> None:
    """Do nothing if all these can be imported; imports none.

    Raises:
        ModuleNotFoundError: one cannot, and the message names the extra that brings it.
    """
    for name in modules:
        if importlib.util.find_spec(name) is None:
            error = ModuleNotFoundError(f"this needs the package {name}", name=name)
            raise ModuleNotFoundError(advice(error), name=name)
