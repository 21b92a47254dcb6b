"""The least restrictive filter: the nominal control stands while success stays likely one control step ahead."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.filters.step_ahead import values_ahead
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


@dataclass(frozen=True)
class LeastRestrictive:
    """The nominal control if E[V(tau - h, X_h)] > p under it, otherwise that of the learned policy.

    It is the least restrictive law of reachability (C. J. Tomlin, J. Lygeros and S. S. Sastry, Proceedings of the IEEE
    88, 2000; J. F. Fisac et al., IEEE Transactions on Automatic Control 64, 2019) with a level of probability in place
    of the boundary of a safe set. There the law keeps the state in the set for all time. Here it bounds success one
    step ahead, but not on a whole path: a nominal control may spend again and again what V gains above p by good luck,
    while bad luck takes V below p for good. `Submartingale` bounds the whole path.

    Args:
        solution: the learned value and policy.
        simulator: gives the control step.
        p: the probability of success that has to stay, in (0, 1).
    """

    solution: Solution
    simulator: Simulator
    p: float

    def __call__(self, tau: Tensor, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The control (N, m) in place of u (N, m), and where it is another (N,), all in SI units like tau and x."""
        refused = values_ahead(self.solution, self.simulator, tau, x, u).mean(0) <= self.p
        return torch.where(refused.unsqueeze(-1), self.solution.policy(tau, x), u), refused
