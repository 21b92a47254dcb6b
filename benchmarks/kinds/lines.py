"""A rope, a game, a washboard, a slope and a gene: problems of one state, in which noise or drift is peculiar."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant
from pirl_rl import Box, ReachAvoidProblem


class Tightrope(ReachAvoidProblem):
    """Keep an unstable balance for 3 s. Every push shakes the rope, to either side, as its square."""

    objective = "invariance"
    horizon = 3.0
    states, controls = Box([-1.0], [1.0]), Box([-2.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 1.2 * x + u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.2 + 0.2 * u.square()).unsqueeze(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1 - x.abs()


class Casino(ReachAvoidProblem):
    """Win a sum before ruin in an unfair game: a bet u costs 0.2 |u| on average, and no bet costs nothing."""

    horizon = 4.0
    states, controls = Box([0.0], [2.0]), Box([-0.8], [0.8])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return -0.2 * u.abs()

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return u.unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return 2 - x

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x


class Washboard(ReachAvoidProblem):
    """Climb over the waves of a washboard that are steeper than the force is strong, before falling off behind."""

    horizon = 6.0
    states, controls = Box([-1.0], [3.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 1.5 * torch.sin(4 * x) + u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.6])

    def target_constraints(self, x: Tensor) -> Tensor:
        return 3 - x

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x + 1


class Uphill(ReachAvoidProblem):
    """Reach the top of a slope in time with hardly any noise, so that V nearly jumps between 0 and 1."""

    horizon = 2.0
    states, controls = Box([-1.0], [1.0]), Box([-0.5], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u - 0.3 * (x + 1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.03])

    def target_constraints(self, x: Tensor) -> Tensor:
        return 0.9 - x


class Gene(ReachAvoidProblem):
    """Breed for a gene until 95 % of a herd carry it, before it is down to 5 %; by the law of Wright and Fisher."""

    horizon = 5.0
    states, controls = Box([0.0], [1.0]), Box([-0.5], [0.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u * x * (1 - x)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.6 * (x * (1 - x)).clamp(min=0).sqrt().unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return 0.95 - x

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x - 0.05
