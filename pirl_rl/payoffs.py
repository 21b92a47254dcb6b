"""Payoffs: the indicator of the target and its smoothings l_eps, as functions of the target's normalised level.

The normalised level d is a signed distance to the target's surface to first order, negative inside. A payoff of width
eps is 1 on the smaller set A_eps = {d <= -eps}, which is what absorbs, and 0 outside A = {d <= 0}; eps = 0 is the hard
indicator with A_eps = A. One payoff serves the environment's reward, the boundary loss, Monte Carlo and grids.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError


class Payoff(Protocol):
    """l_eps as a function of the normalised level: (*) -> (*) in [0, 1], 1 for d <= -epsilon, 0 for d > 0."""

    @property
    def epsilon(self) -> float: ...

    def __call__(self, level: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Indicator:
    """1_A, the payoff of the reach-avoid problem itself, Eq. (exit_value)."""

    epsilon: float = 0.0

    def __post_init__(self):
        if self.epsilon != 0:
            raise ArgumentError(f"Indicator: epsilon is 0 by definition, got {self.epsilon}")

    def __call__(self, level: Tensor) -> Tensor:
        return (level <= 0).to(level.dtype)


@dataclass(frozen=True)
class _Smoothed:
    epsilon: float

    def __post_init__(self):
        if not self.epsilon > 0:
            raise ArgumentError(f"{type(self).__name__}: epsilon must be positive, got {self.epsilon}")

    def _ramp(self, level: Tensor) -> Tensor:
        return (-level / self.epsilon).clamp(0, 1)


@dataclass(frozen=True)
class LipschitzPayoff(_Smoothed):
    """max(1 - dist(x, A_eps)/eps, 0), Eq. (continuous_terminal_cost). epsilon in units of the level."""

    def __call__(self, level: Tensor) -> Tensor:
        return self._ramp(level)


@dataclass(frozen=True)
class SmoothPayoff(_Smoothed):
    """A C^3 payoff, as the paper's Assumption 2 (c) asks: the septic smoothstep of the same ramp."""

    def __call__(self, level: Tensor) -> Tensor:
        ramp = self._ramp(level)
        s = torch.minimum(ramp, 1 - ramp)
        rise = s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
        # Symmetric about 1/2; rounding in the polynomial near s = 1 would exceed 1.
        return torch.where(ramp < 0.5, rise, 1 - rise)
