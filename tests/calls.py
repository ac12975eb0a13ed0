"""Calls as one compiled program: by itself, JAX would compile each operation in them."""

import equinox as eqx


@eqx.filter_jit
def called(function, *arguments):
    """The function's result; what it holds, such as weights, is an argument here, not a constant."""
    return function(*arguments)
