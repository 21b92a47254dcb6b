"""V against the mean payoff of rollouts: does the value say what the policy does?"""

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
    """V at N points, and the mean payoff of paths that the same policy plays from there; tensors on the CPU.

    Attributes:
        tau: times to go (N,), s.
        x: states (N, n), SI.
        value: V (N,), float64: 1 in A, 0 in B and where the problem knows that the target is out of reach.
        raw_value: the networks' own V (N,), float64.
        monte_carlo: the mean payoffs (N,), float64.
        rollouts: paths from each point, at least 2.
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
        """Play `rollouts` paths from each of the points (N,) and (N, n), which are on the solution's device.

        Args:
            solution: the value and the policy.
            simulator: plays the paths.
            tau, x: the points, in the solution's dtype.
            rollouts: paths from each, at least 2.
            seed: of the noise.
        """
        mean = mean_payoff(simulator, solution.policy, tau, x, rollouts, noise_rng(solution, seed)).cpu()
        value, raw = (function(tau, x).cpu().double() for function in (solution.value, solution.raw_value))
        return cls(tau.cpu(), x.cpu(), value, raw, mean, rollouts)

    @property
    def error(self) -> Tensor:
        """V minus Monte Carlo (N,)."""
        return self.value - self.monte_carlo

    def mse(self, where: Tensor | None = None) -> float:
        """The mean square of the error, over all points or those of `where`, (N,) bool; NaN where there are none."""
        square = self.error.square()
        return (square if where is None else square[where]).mean().item()

    def mae(self) -> float:
        """The mean absolute error."""
        return self.error.abs().mean().item()

    def noise(self) -> float:
        """The mean square error that a perfect V would have: the variance of the Monte Carlo means.

        For payoffs of 0 and 1 its estimate is unbiased, for others in [0, 1] it is an upper bound.
        """
        mean = self.monte_carlo
        return (mean * (1 - mean)).mean().item() / (self.rollouts - 1)

    def raw_mse(self) -> float:
        """The mean square of the networks' own V minus Monte Carlo."""
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
    """The share of `whole` that is `part`, both (N,) bool; 1 of an empty one, where nothing is wrong."""
    return (part.double().sum() / whole.sum() if whole.any() else torch.ones(())).item()
