"""What is printed of a replay."""

import io

import jax.numpy as jnp
import numpy as np
from rich.console import Console

from doojax.datasets.replay import _show
from doojax.simulation.state import Fault
from doojax.types import Trajectory


def test_faults_have_their_whole_names_in_a_terminal_of_80_columns():
    console = Console(file=io.StringIO(), width=80)
    points = np.zeros((3, 4, 3))
    faults = [0, int(Fault.NOT_FINITE | Fault.NEIGHBOURS_DROPPED)]
    measured = {"clearance": jnp.full((1, 3), -0.0123), "stretch": jnp.full((1, 3), 12.345)}
    again = Trajectory(points, jnp.zeros((1, 2, 1, 3)), jnp.array([faults]), **measured)
    _show(console, points, points + 1e-9, faults, [0, int(Fault.CONTACTS_DROPPED)], again)
    lines = [line.split() for line in console.file.getvalue().splitlines()]
    assert ["0", "1.73e-09", "-0.0123", "1234.50%", "-", "-"] in lines
    last = ["1", "1.73e-09", "-0.0123", "1234.50%", "NOT_FINITE", "CONTACTS_DROPPED"]
    assert lines[lines.index(last) + 1] == ["NEIGHBOURS_DROPPED"]
