"""The error of the learned value where the exact one is known."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.solution import Solution


class ExactError:
    """Learned against exact V on the paper's grid: tau in [0, T] x states, tau = 0 and all edges included.

    A problem of several dimensions has `tau_points * x_points` uniform points of the same box in its place.

    Args:
        tau_points: grid points in tau.
        x_points: grid points in x.
        seed: of the points in several dimensions.
    """

    def __init__(self, tau_points: int = 101, x_points: int = 201, seed: int = 0):
        if tau_points < 2 or x_points < 2:
            raise ArgumentError(f"ExactError: expected tau_points, x_points >= 2, got {tau_points} and {x_points}")
        self.tau_points, self.x_points, self.seed = tau_points, x_points, seed

    def __call__(self, solution: Solution) -> dict[str, float]:
        """value_mse, value_max_error, masked_value_mse; nothing where no exact value is known."""
        tau, x = self._points(solution.problem)
        exact = solution.problem.exact_value(tau, x)
        if exact is None:
            return {}
        inputs = tau.to(solution.device, solution.dtype), x.to(solution.device, solution.dtype)
        raw = solution.raw_value(*inputs).cpu().double() - exact
        masked = solution.value(*inputs).cpu().double() - exact
        return {
            "value_mse": raw.square().mean().item(),
            "value_max_error": raw.abs().max().item(),
            "masked_value_mse": masked.square().mean().item(),
        }

    def _points(self, problem: ReachAvoidProblem) -> tuple[Tensor, Tensor]:
        """tau (N,) and x (N, n) in float64."""
        count, box = self.tau_points * self.x_points, problem.states
        if box.dim > 1:
            rng = torch.Generator().manual_seed(self.seed)
            tau = problem.horizon * torch.rand(count, generator=rng, dtype=torch.float64)
            return tau, box.sample(count, rng, dtype=torch.float64)
        tau = torch.linspace(0, problem.horizon, self.tau_points, dtype=torch.float64)
        x = torch.linspace(box.low[0], box.high[0], self.x_points, dtype=torch.float64)
        return tau.repeat_interleave(self.x_points), x.repeat(self.tau_points).unsqueeze(-1)
