"""The error of the learned value, for problems whose exact value is known."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evaluator import Metrics
from pirl_rl.evaluation.inputs import like
from pirl_rl.problem import ReachAvoidProblem, closed_form
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class ExactError:
    """Compares V with the exact value on the paper's grid over tau in [0, T] and the box of states, edges included.

    For a problem of several dimensions, `tau_points * x_points` uniform random points replace the grid. A problem whose
    exact value is not known has no metrics.

    Args:
        tau_points: number of grid points in tau, at least 2.
        x_points: number of grid points in x, at least 2.
        seed: seed of the random points.

    Raises:
        ArgumentError: if an axis has fewer than two points.
    """

    def __init__(self, tau_points: int = 101, x_points: int = 201, seed: int = 0):
        if tau_points < 2 or x_points < 2:
            raise ArgumentError(f"ExactError: expected tau_points, x_points >= 2, got {tau_points} and {x_points}")
        self.tau_points, self.x_points, self.seed = tau_points, x_points, seed

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        if closed_form(problem, *self._points(problem)) is None:
            return {}
        where = f"{self.tau_points * self.x_points:,} random points of tau in [0, T] and x in the box of states"
        if problem.states.dim == 1:
            where = (
                f"the {self.tau_points} x {self.x_points} grid of tau in [0, T] and x in the box of states, edges "
                "included"
            )
        return {
            "value_mse": f"The mean square of the V of the networks alone minus the exact V, on {where}.",
            "value_max_error": "The largest absolute error on the points of value_mse.",
            "masked_value_mse": "As value_mse, with V set to 1 in A and to 0 in B.",
        }

    def __call__(self, solution: Solution, simulator: Simulator) -> Metrics:
        tau, x = self._points(solution.problem)
        exact = closed_form(solution.problem, tau, x)
        if exact is None:
            return Metrics({})
        inputs = like(solution, tau, x)
        raw = solution.raw_value(*inputs).cpu().double() - exact
        masked = solution.value(*inputs).cpu().double() - exact
        return Metrics(
            {
                "value_mse": raw.square().mean().item(),
                "value_max_error": raw.abs().max().item(),
                "masked_value_mse": masked.square().mean().item(),
            }
        )

    def _points(self, problem: ReachAvoidProblem) -> tuple[Tensor, Tensor]:
        """tau (N,) and x (N, n) in float64."""
        count, box = self.tau_points * self.x_points, problem.states
        if box.dim > 1:
            rng = torch.Generator().manual_seed(self.seed)
            tau = problem.horizon * torch.rand(count, generator=rng, dtype=torch.float64)
            return tau, box.sample(count, rng, dtype=torch.float64)
        tau = torch.linspace(0, problem.horizon, self.tau_points, dtype=torch.float64)
        x = torch.linspace(box.low[0], box.high[0], self.x_points, dtype=torch.float64)
        return tau.repeat_interleave(self.x_points), box.wrap(x.repeat(self.tau_points).unsqueeze(-1))
