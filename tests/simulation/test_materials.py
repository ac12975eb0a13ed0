"""Ropes as data sheets describe them: rods and hoses of one material."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from doojax.simulation.rope import RopeParameters

HOSE = {"length": 2.0, "radius": 0.01, "mass": 0.3, "youngs_modulus": 5e6}


def test_a_hose_bends_as_a_table_of_sections_says():
    """20 mm outside, 14 mm inside: I = pi (20^4 - 14^4) / 64 = 5968.4 mm^4; times 5 MPa."""
    hose = RopeParameters.of_material(**HOSE, bore=0.007)
    assert hose.bending_stiffness == pytest.approx(5e6 * 5968.4e-12, rel=1e-4)
    assert (hose.length, hose.radius, hose.mass) == (2.0, 0.01, 0.3)


@given(st.floats(0, 0.95), st.floats(-0.9, 0.5))
def test_stiffnesses_are_integrals_over_the_section(hollow, poisson):
    """EI = E times the integral of y^2 and GJ = G times that of r^2, over rings, with G = E / 2 (1 + nu)."""
    rope = RopeParameters.of_material(**HOSE, bore=hollow * 0.01, poisson=poisson)
    edges = np.linspace(hollow * 0.01, 0.01, 2001)
    r = (edges[1:] + edges[:-1]) / 2
    polar = (r**2 * 2 * np.pi * r * np.diff(edges)).sum()
    assert rope.bending_stiffness == pytest.approx(5e6 * polar / 2, rel=1e-5)
    assert rope.twisting_stiffness == pytest.approx(5e6 / (2 * (1 + poisson)) * polar, rel=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bore": 0.01}, r"bore is 0.01, expected at least 0 and less than the radius of 0.01"),
        ({"youngs_modulus": -1.0}, "youngs_modulus is -1"),
        ({"poisson": 0.6}, "poisson 0.6"),
        ({"mass": 0.0}, "rope mass is 0"),
    ],
)
def test_what_no_material_is_like_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        RopeParameters.of_material(**HOSE | changes)
