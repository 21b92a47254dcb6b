"""The names under which Gymnasium makes environments of the problems that come with the package."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

import gymnasium

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.gymnasium.environments import ReachAvoidGym, ReachAvoidVectorGym
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Crossing, Simulator
from pirl_rl.time_steps import propose_time_steps

PROBLEMS = "pirl_rl.problems"
"""The module of the problems. It stands on a higher floor, and is named here as a configuration names a class."""


def register_problems() -> None:
    """Register `pirl_rl/<class>-v0` for every problem of the package, for `gymnasium.make` and `gymnasium.make_vec`."""
    for name in import_module(PROBLEMS).__all__:
        gymnasium.register(
            id=f"pirl_rl/{name}-v0",
            entry_point=f"{__name__}:make",
            vector_entry_point=f"{__name__}:make_vector",
            kwargs={"problem": name},
        )


def make(problem: str | ReachAvoidProblem, **settings: Any) -> ReachAvoidGym:
    """One path of a problem, with the time steps that `pirl_rl.time_steps` proposes for it.

    Args:
        problem: the name of a class of `pirl_rl.problems`, or a problem.
        settings: other arguments of `ReachAvoidEnv`; `dt` and `substeps` replace those proposed.
    """
    physics = _problem(problem)
    return ReachAvoidGym(physics, **_with_time_steps(problem, physics, settings))


def make_vector(problem: str | ReachAvoidProblem, num_envs: int = 1, **settings: Any) -> ReachAvoidVectorGym:
    """Many paths of a problem, which are simulated together.

    Args:
        problem: see `make`.
        num_envs: the number of paths.
        settings: see `make`.
    """
    physics = _problem(problem)
    env = ReachAvoidEnv(physics, num_envs=num_envs, **_with_time_steps(problem, physics, settings))
    return ReachAvoidVectorGym(env)


def _problem(problem: str | ReachAvoidProblem) -> ReachAvoidProblem:
    return getattr(import_module(PROBLEMS), problem)() if isinstance(problem, str) else problem


def _with_time_steps(
    named: str | ReachAvoidProblem, problem: ReachAvoidProblem, settings: dict[str, Any]
) -> dict[str, Any]:
    dt, substeps, crossing = (settings.get(name) for name in ("dt", "substeps", "crossing"))
    if dt is not None and substeps is not None:
        return settings
    # The proposal takes seconds, and a process often makes several environments of one problem.
    given = dt, substeps, crossing or Simulator.crossing
    proposed = _proposed(named, *given) if isinstance(named, str) else _time_steps(problem, *given)
    return {**settings, "dt": proposed[0], "substeps": proposed[1]}


@cache
def _proposed(name: str, dt: float | None, substeps: int | None, crossing: Crossing) -> tuple[float, int]:
    return _time_steps(_problem(name), dt, substeps, crossing)


def _time_steps(
    problem: ReachAvoidProblem, dt: float | None, substeps: int | None, crossing: Crossing
) -> tuple[float, int]:
    steps = propose_time_steps(problem, dt, substeps, crossing=crossing)
    return steps.dt, steps.substeps
