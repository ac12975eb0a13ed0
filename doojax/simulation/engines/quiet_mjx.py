"""MJX, imported without what it prints where warp is missing, which is no fault."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx as mjx
