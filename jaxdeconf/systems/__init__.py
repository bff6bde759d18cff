"""What moves: physical systems as pure functions of (state, action)."""

from jaxdeconf import checks
from jaxdeconf.systems.cartpole import CARTPOLE
from jaxdeconf.systems.reacher import REACHER
from jaxdeconf.systems.rollout import Trajectories, random_trajectories, rollout
from jaxdeconf.systems.system import System

__all__ = ["System", "Trajectories", "get", "names", "random_trajectories", "rollout"]

_SYSTEMS = {system.name: system for system in (CARTPOLE, REACHER)}


def names() -> tuple[str, ...]:
    """The names that `get` knows."""
    return tuple(_SYSTEMS)


def get(name: str) -> System:
    """The system of that name.

    Raises:
      ValueError: if there is none; the message lists the known names.
    """
    checks.one_of("name", name, names())
    return _SYSTEMS[name]
