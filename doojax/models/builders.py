"""How each kind of model is built from the config in its file's header."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax

from doojax.models.dynamics import DynamicsConfig, UnconstrainedDynamics
from doojax.models.ensemble import Ensemble


def dynamics(config: Mapping[str, Any]) -> Ensemble:
    """An `Ensemble`; config: members, and the fields of `DynamicsConfig`."""
    network = DynamicsConfig(**{name: value for name, value in config.items() if name != "members"})
    keys = jax.random.split(jax.random.key(0), config["members"])
    return Ensemble(eqx.filter_vmap(lambda key: UnconstrainedDynamics(network, key=key))(keys))


BUILDERS: Mapping[str, Callable[[dict[str, Any]], Any]] = {"dynamics": dynamics}
