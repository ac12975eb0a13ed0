"""Tasks as environments for reinforcement learning: pure functions, and faces for brax and gymnasium."""

from doojax.environments.base import Environment as Environment
from doojax.environments.base import EnvironmentState as EnvironmentState
from doojax.environments.base import make_environment as make_environment
from doojax.environments.observations import action_size as action_size
from doojax.environments.observations import command as command
from doojax.environments.observations import features as features
from doojax.environments.observations import taken as taken
