"""What a user might take in place of the learned policy, for comparison: a regulator, and two learners of a library."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from pirl_rl.arguments import Policy
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator

__all__ = ["RIVALS", "Rival", "find_rival"]

Rival = Callable[[ReachAvoidProblem, Simulator, float, int], Policy]
"""Maps the physics, the simulator, the time of training in s and a seed to a policy."""

RIVALS = {
    "lqr": "linear_quadratic:linear_quadratic",
    "ppo": "stable_baselines:ppo",
    "sac": "stable_baselines:sac",
}
"""Modules and functions of the rivals, which are imported when they are asked for: some need the extra `baselines`."""


def find_rival(name: str) -> Rival:
    """The rival of a name.

    Raises:
        ArgumentError: there is none, or its packages are not installed.
    """
    if name not in RIVALS:
        raise ArgumentError(f"rivals: expected names out of {', '.join(RIVALS)}, got {name!r}")
    module, function = RIVALS[name].split(":")
    try:
        return getattr(import_module(f"{__name__}.{module}"), function)
    except ModuleNotFoundError as error:
        raise ArgumentError(f"rivals: {name} needs {error.name}: pip install 'pirl_rl[baselines]'") from None
