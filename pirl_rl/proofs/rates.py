"""The control for which a fit asks L^u W >= 0: that of a policy, or at each state the one with the least L^u W.

The factors of a fit are the drift and the covariances at points, (terms, N) as in `States.factors`, for a time to go
and the derivatives (terms, N) of W. They make the equation of W, and prove nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from pirl_rl.proofs.points import States
from pirl_rl.structure import has_controlled_noise

Policy = Callable[[Tensor, Tensor], Tensor]
"""Maps tau (N,) and x (N, n), float64, to the control (N, m) in SI units."""

Rates = Callable[[float, np.ndarray], np.ndarray]
"""Maps a time to go and the derivatives (terms, N) of W to the factors (terms, N)."""

RatesAt = Callable[[States], Rates]
"""Gives the rates at points."""

PLACES = 5
"""The number of values that are compared along each control, with both ends of its range among them."""


def controls_at(policy: Policy, tau: float, points: States) -> Tensor:
    """The controls (N, m) of a policy at points, with one time to go."""
    x = torch.from_numpy(points.x)
    return policy(torch.full((len(x),), tau, dtype=torch.float64), x)


class PolicyRates:
    """The factors under a policy, whose controls are kept.

    Args:
        points: the states.
        policy: the policy.
    """

    def __init__(self, points: States, policy: Policy):
        self._points, self._policy = points, policy
        self._controls: dict[float, Tensor] = {}

    def __call__(self, tau: float, derivatives: np.ndarray) -> np.ndarray:
        if tau not in self._controls:
            self._controls[tau] = controls_at(self._policy, tau, self._points)
        return self._points.factors(self._controls[tau])


class LeastRates:
    """The factors under the control with the least L^u W.

    Each control is chosen out of a few values while the others are in the middle of their range. This is exact where
    the drift is affine in u and the noise does not depend on it; the effort is proportional to the number of controls.

    Args:
        points: the states.
    """

    def __init__(self, points: States):
        self._points, box = points, points.problem.controls
        low, high = (torch.tensor(end, dtype=torch.float64) for end in (box.low, box.high))
        self._middle = ((low + high) / 2).expand(len(points.x), -1)
        self._values = torch.linspace(0, 1, PLACES, dtype=torch.float64).unsqueeze(-1) * (high - low) + low
        # Only the drift, the first n of the terms, depends on u where the noise does not.
        terms = None if has_controlled_noise(points.problem) else points.x.shape[1]
        self._factors = [[points.factors(self._with(i, k))[:terms] for k in range(PLACES)] for i in range(box.dim)]

    def __call__(self, tau: float, derivatives: np.ndarray) -> np.ndarray:
        u = self._middle.clone()
        for i, choices in enumerate(self._factors):
            change = [np.einsum("kn,kn->n", factors, derivatives[: len(factors)]) for factors in choices]
            u[:, i] = self._values[torch.from_numpy(np.argmin(change, 0)), i]
        return self._points.factors(u)

    def _with(self, control: int, place: int) -> Tensor:
        """The middle controls (N, m) with one of them at one of its values."""
        u = self._middle.clone()
        u[:, control] = self._values[place, control]
        return u
