"""Modules whose instances and methods `jax.jit` takes as they are."""

import inspect
from collections.abc import Callable
from types import MethodType
from typing import Any

import equinox as eqx


class Jittable(eqx.Module):
    """An `equinox.Module` that may be given to `jax.jit`, and to all that hashes what it transforms.

    `jax.jit` finds what it has compiled by the hash of the function that it is given. A module of equinox
    hashes by its fields, which arrays do not allow: ``jax.jit(model)`` and ``jax.jit(simulator.step)`` raise
    "unhashable type". An instance of this class hashes, and is equal, by identity, as functions are; a method
    of an instance by that of the instance and of the function. Everything else is equinox's: instances and
    their methods are pytrees.

    What `jax.jit` is given it holds as constants. That can never be out of date, because instances are
    immutable: other arrays make another instance, which is compiled anew. Where the arrays change often, as
    in training, pass the instance as an argument instead: ``eqx.filter_jit(lambda model, x: model(x))``.
    Derivatives by a model's arrays need that, too. ``eqx.tree_equal`` compares by value.
    """

    def __hash__(self) -> int:
        return object.__hash__(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    def __getattribute__(self, name: str) -> Any:
        found = object.__getattribute__(self, name)
        if name.startswith("__"):
            return found
        if isinstance(found, MethodType) and found.__self__ is self:
            return Method(found.__func__, self)
        # Equinox's transformations of methods, such as eqx.filter_jit, bind them like this.
        if isinstance(found, eqx.Partial) and len(found.args) == 1 and found.args[0] is self:
            return Method(found.func, self)
        return found


class Method(eqx.Module):
    """A method of an instance: a pytree that holds the instance, equal to the same method of the same one."""

    function: Callable = eqx.field(static=True)
    instance: Jittable

    def __post_init__(self):
        """Take over the function's name and documentation."""
        for name in ("__module__", "__name__", "__qualname__", "__doc__"):
            setattr(self, name, getattr(self.function, name))

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """What the method gives."""
        return self.function(self.instance, *arguments, **named)

    @property
    def __wrapped__(self) -> Callable:
        """Shows `inspect.signature` the arguments."""
        return MethodType(inspect.unwrap(self.function), self.instance)

    def __hash__(self) -> int:
        return hash((self.function, self.instance))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Method) and self.function == other.function and self.instance is other.instance
        )
