"""The learned V against the mean payoff of rollouts of the learned policy."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.evaluation.inputs import noise_rng
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


@dataclass(frozen=True)
class RolloutComparison:
    """V at N points, and the mean payoff of paths of the learned policy from there; all tensors are on the CPU.

    Attributes:
        tau: times to go (N,) in s.
        x: states (N, n) in SI units.
        value: V (N,), float64: 1 in A, 0 in B and where the problem knows that the target is out of reach.
        raw_value: V of the networks alone (N,), float64, without these masks.
        monte_carlo: mean payoffs (N,), float64.
        rollouts: number of paths from each point, at least 2.
    """

    tau: Tensor
    x: Tensor
    value: Tensor
    raw_value: Tensor
    monte_carlo: Tensor
    rollouts: int

    @classmethod
    def measure(
        cls, solution: Solution, simulator: Simulator, tau: Tensor, x: Tensor, rollouts: int, seed: int
    ) -> RolloutComparison:
        """Play `rollouts` paths from each point.

        Args:
            solution: the value and the policy.
            simulator: plays the paths.
            tau: times to go (N,) in s, in the solution's dtype and on its device.
            x: states (N, n) in SI units, likewise.
            rollouts: number of paths from each point, at least 2.
            seed: seed of the noise.
        """
        mean = mean_payoff(simulator, solution.policy, tau, x, rollouts, noise_rng(solution, seed)).cpu()
        value, raw = (function(tau, x).cpu().double() for function in (solution.value, solution.raw_value))
        return cls(tau.cpu(), x.cpu(), value, raw, mean, rollouts)

    @property
    def error(self) -> Tensor:
        """V minus Monte Carlo (N,)."""
        return self.value - self.monte_carlo

    def mse(self, where: Tensor | None = None) -> float:
        """The mean square of the error over all points, or over those of the mask `where` (N,); NaN without points."""
        square = self.error.square()
        return (square if where is None else square[where]).mean().item()

    def mae(self) -> float:
        """The mean absolute error."""
        return self.error.abs().mean().item()

    def noise(self) -> float:
        """The mean square error that a perfect V would have: the variance of the Monte Carlo means.

        The estimate is unbiased for payoffs of 0 and 1, and an upper bound for others in [0, 1].
        """
        mean = self.monte_carlo
        return (mean * (1 - mean)).mean().item() / (self.rollouts - 1)

    def raw_mse(self) -> float:
        """The mean square of `raw_value` minus Monte Carlo."""
        return (self.raw_value - self.monte_carlo).square().mean().item()

    def precision(self, p: float) -> float:
        """The share of the points with V > p whose Monte Carlo is above p too."""
        claimed, true = self.value > p, self.monte_carlo > p
        return _share(claimed & true, claimed)

    def recall(self, p: float) -> float:
        """The share of the points with Monte Carlo > p whose V is above p too."""
        claimed, true = self.value > p, self.monte_carlo > p
        return _share(claimed & true, true)


def _share(part: Tensor, whole: Tensor) -> float:
    """The share of the points of the mask `whole` (N,) that are in `part` (N,); 1 if `whole` is empty."""
    return (part.double().sum() / whole.sum() if whole.any() else torch.ones(())).item()
