"""Control steps and the time to go: all steps are dt long but the last, which is shorter where dt does not divide tau.

A time to go tau takes ceil(tau/dt) steps, at tau, tau - dt, ..., and the last one ends exactly at 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

ROUNDING = 1e-4
"""The fraction of a step by which tau may differ from whole steps because of rounding."""

SINGLE = 4 * torch.finfo(torch.float32).eps
"""The relative error of tau after arithmetic in single precision, which exceeds `ROUNDING` where steps are many."""


@dataclass(frozen=True)
class Clock:
    """Counts the control steps of a horizon.

    Args:
        dt: the length of a control step, in s.
        horizon: T, in s.
    """

    dt: float
    horizon: float

    @property
    def max_steps(self) -> int:
        """The number of control steps of the whole horizon."""
        return math.ceil(self.horizon / self.dt - self._tolerance)

    @property
    def shortfall(self) -> float:
        """How much shorter the last step from the horizon is than dt, in s; 0 if dt divides the horizon."""
        excess = self.max_steps * self.dt - self.horizon
        return excess if excess > self._tolerance * self.dt else 0.0

    def split(self, tau: Tensor) -> tuple[Tensor, Tensor]:
        """The numbers of steps (*), int64, that fill tau (*), in s, and how much shorter the last is than dt (*)."""
        whole = tau.double() / self.dt
        steps = torch.ceil(whole - self._tolerance).clamp(min=0)
        excess = steps - whole
        return steps.long(), self.dt * torch.where(excess > self._tolerance, excess, torch.zeros_like(excess))

    def length(self, steps: Tensor, shortfall: Tensor | float) -> Tensor:
        """The length (*), in s and double precision, of the next step with `steps` (*) left, the last being shorter."""
        return self.dt - (steps == 1) * torch.as_tensor(shortfall, dtype=torch.float64)

    def time(self, steps: Tensor, shortfall: Tensor | float | None = None) -> Tensor:
        """The time to go (*), in s, with `steps` (*) left; by default of an episode that started at the horizon."""
        short = self.shortfall if shortfall is None else shortfall
        return (steps * self.dt - short).clamp(min=0)

    @property
    def _tolerance(self) -> float:
        return max(ROUNDING, SINGLE * self.horizon / self.dt)
