"""An encounter in the air, and a landing with little fuel."""

from __future__ import annotations

import math

from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Encounter(ReachAvoidProblem):
    """Keep away from a faster aircraft whose pilot turns at random.

    The states are its place, seen from the own cockpit, and its heading relative to the own one, which is periodic.
    After C. Tomlin, J. Lygeros and S. Sastry, "A game theoretic approach to controller design for hybrid systems",
    2000, where the other pilot is hostile.
    """

    objective = "invariance"
    horizon = 3.0
    states = Box([-2.5, -2.5, -math.pi], [2.5, 2.5, math.pi], periodic=[2])
    controls = Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        ahead, aside, heading = x.unbind(-1)
        turn = u[..., 0]
        return rows(1.5 * heading.cos() - 1 + turn * aside, 1.5 * heading.sin() - turn * ahead, -turn)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.2, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.8])

    def avoid_level(self, x: Tensor) -> Tensor:
        return x[..., :2].norm(dim=-1) - 0.7


class Descent(ReachAvoidProblem):
    """Land softly before the fuel is used up; height, speed and fuel, noise in the speed alone."""

    horizon = 4.0
    states, controls = Box([0.0, -2.5, 0.0], [4.0, 1.5, 1.0]), Box([0.0], [2.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        thrust = u[..., 0]
        return rows(x[..., 1], thrust - 1, -0.15 * thrust)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.5], [0.0])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0] - 0.3, x[..., 1].abs() - 0.6)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0], x[..., 2])
