"""Problems of the suite with other constants, each multiplied by a random factor."""

from __future__ import annotations

import random
from functools import partial
from typing import Any

from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.problems import DoubleIntegrator, DubinsCar, Pendulum, ZermeloBoat

CONSTANTS: dict[type[ReachAvoidProblem], tuple[str, ...]] = {
    DoubleIntegrator: ("horizon", "noise", "controls", "tolerance"),
    Pendulum: ("horizon", "noise", "controls", "gravity"),
    ZermeloBoat: ("horizon", "noise", "controls", "current", "landing_radius", "rock_radius"),
    DubinsCar: ("horizon", "noise", "controls", "speed", "target_radius", "rock_radius"),
}
"""What a draw multiplies: noise and controls in all their coordinates by the same factor."""

DRAWS = 4
"""The number of draws of each problem among `OTHERS`."""


def drawn(kind: type[ReachAvoidProblem], number: int) -> ReachAvoidProblem:
    """A problem with constants of its own, multiplied by 2**U with U uniform in [-1, 1].

    Args:
        kind: one of `CONSTANTS`.
        number: the number of the draw, which determines the factors.
    """
    problem, rng = kind(), random.Random(f"{kind.__name__} {number}")
    for name in CONSTANTS[kind]:
        setattr(problem, name, _scaled(getattr(problem, name), 2 ** rng.uniform(-1, 1)))
    return problem


def _scaled(constant: Any, factor: float) -> Any:
    if isinstance(constant, Box):
        return Box(_scaled(constant.low, factor), _scaled(constant.high, factor))
    return tuple(factor * value for value in constant) if isinstance(constant, tuple) else factor * constant


OTHERS = {f"{kind.__name__}-{k}": partial(drawn, kind, k) for kind in CONSTANTS for k in range(1, DRAWS + 1)}
"""Makers of the drawn problems, by names such as DubinsCar-1."""
