"""The filter that bounds success on whole paths: a power of V must not fall in expectation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.filters.step_ahead import values_ahead
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

MARGIN = 0.05
"""The largest distance from p of the V from which a path succeeds with probability p."""


@dataclass(frozen=True)
class Submartingale:
    """The nominal control if E[V(tau - h, X_h)^k] >= V(tau, x)^k under it, otherwise that of the learned policy.

    For the exact V, V(tau, X) is a martingale under the optimal policy. V^k with k > 1 then grows in expectation by
    Jensen's inequality, and that growth is what a nominal control may spend. In both cases V^k is a submartingale. At
    the end of a path it is 1 after success and 0 otherwise, so that the path succeeds with probability V(tau, x)^k or
    more, whatever the nominal controller does. The exponent k is such that this is p at V = p + min(0.05, (1 - p)/2).
    Barrier functions bound the risk of stochastic systems within a finite time by conditions of this kind (C. Santoyo,
    M. Dutreix and S. Coogan, Automatica 125, 2021).

    Args:
        solution: the learned value and policy.
        simulator: gives the control step.
        p: the probability of success of paths that start at V >= p + min(0.05, (1 - p)/2), in (0, 1).
    """

    solution: Solution
    simulator: Simulator
    p: float

    @property
    def exponent(self) -> float:
        """k, above 1."""
        return math.log(self.p) / math.log(self.p + min(MARGIN, (1 - self.p) / 2))

    def __call__(self, tau: Tensor, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The control (N, m) in place of u (N, m), and where it is another (N,), all in SI units like tau and x."""
        ahead = values_ahead(self.solution, self.simulator, tau, x, u).pow(self.exponent).mean(0)
        refused = ahead < self.solution.value(tau, x).pow(self.exponent)
        return torch.where(refused.unsqueeze(-1), self.solution.policy(tau, x), u), refused
