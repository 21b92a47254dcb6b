"""Payoffs: the indicator of the target A and its smoothings l_eps, as functions of the normalised level of A.

The normalised level d is the signed distance to the surface of A, to first order; it is negative inside and has the
units of the state. A payoff of width eps is 1 on the smaller set A_eps = {d <= -eps}, which then absorbs in place of A,
and 0 outside A = {d <= 0}. With eps = 0 it is the indicator, and A_eps = A. The reward, the boundary loss and Monte
Carlo all use the payoff of the problem.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError


class Payoff(Protocol):
    """Maps normalised levels d (*) to l_eps (*) in [0, 1]: 1 for d <= -epsilon, 0 for d > 0."""

    @property
    def epsilon(self) -> float:
        """The width of the payoff, >= 0, in the units of the level."""
        ...

    def __call__(self, level: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Indicator:
    """The indicator of A, the payoff of the reach-avoid problem itself, Eq. (exit_value).

    Args:
        epsilon: 0, since the indicator has no width.

    Raises:
        ArgumentError: `epsilon` is not 0.
    """

    epsilon: float = 0.0

    def __post_init__(self):
        if self.epsilon != 0:
            raise ArgumentError(f"Indicator: expected epsilon = 0, since an indicator has no width, got {self.epsilon}")

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
    """l_eps(x) = max(1 - dist(x, A_eps)/eps, 0), Eq. (continuous_terminal_cost).

    Args:
        epsilon: the width eps > 0, in the units of the level.

    Raises:
        ArgumentError: `epsilon` is not positive.
    """

    def __call__(self, level: Tensor) -> Tensor:
        return self._ramp(level)


@dataclass(frozen=True)
class SmoothPayoff(_Smoothed):
    """The septic smoothstep of the ramp of `LipschitzPayoff`. It is C^3, as Assumption 2 (c) of the paper requires.

    Args:
        epsilon: the width eps > 0, in the units of the level.

    Raises:
        ArgumentError: `epsilon` is not positive.
    """

    def __call__(self, level: Tensor) -> Tensor:
        ramp = self._ramp(level)
        s = torch.minimum(ramp, 1 - ramp)
        rise = s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
        # The upper half mirrors the lower one, because rounding of the polynomial near s = 1 would give values above 1.
        return torch.where(ramp < 0.5, rise, 1 - rise)
