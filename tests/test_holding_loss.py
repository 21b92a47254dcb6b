"""What holding the control costs on a grid, against simulation and against its law."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pirl_rl.grid import GridSolution, GridSolver
from pirl_rl.grid.held import loss_of_holding
from pirl_rl.problems import HalfSpace, Safety1D
from pirl_rl.simulator import Simulator, exit_value


@pytest.fixture(scope="module")
def safety() -> GridSolution:
    return GridSolver(Safety1D(), 201, estimate=False).solve()


def played(solution: GridSolution, steps: int, substeps: int, paths: int) -> Tensor:
    """The payoffs (paths,) with so many control steps in the horizon; equal numbers of sub-steps have equal noise."""
    problem, rng = solution.problem, torch.Generator().manual_seed(3)
    x = problem.states.sample(paths, rng, torch.float64)
    # Whole periods of 1/25 of the horizon, which all numbers of steps divide.
    left = torch.randint(1, 26, (paths,), generator=rng) * (steps // 25)
    simulator, payoff, alive = Simulator(problem, problem.horizon / steps, substeps), torch.zeros(paths), left > 0
    while alive.any():
        step = simulator.step(x, solution.policy(left.clamp(min=0) * simulator.dt, x), rng)
        left = left - 1
        ended = alive & (step.failed | (left <= 0))
        payoff[ended] = exit_value(problem, step)[ended].float()
        alive, x = alive & ~ended, torch.where(alive.unsqueeze(-1), step.state, x)
    return payoff


def test_the_loss_is_that_of_simulated_paths(safety):
    """Between 25 control steps and 200, within four standard errors: 7/8 of the loss with 25 steps, of about 0.024."""
    difference = played(safety, 200, 1, 20_000) - played(safety, 25, 8, 20_000)
    expected = 7 / 8 * loss_of_holding(safety, safety.problem.horizon / 25, 4).mean
    error = difference.std().item() / 20_000**0.5
    assert error < 0.002
    assert difference.mean().item() == pytest.approx(expected, abs=4 * error)


def test_the_loss_is_proportional_to_the_control_step(safety):
    losses = [loss_of_holding(safety, safety.problem.horizon / steps) for steps in (200, 800)]
    # The paths are other ones.
    error = (losses[0].error ** 2 + (4 * losses[1].error) ** 2) ** 0.5
    assert losses[0].mean == pytest.approx(4 * losses[1].mean, abs=4 * error + 0.1 * losses[0].mean)
    assert losses[0].mean > 20 * losses[0].error


def test_a_control_that_never_changes_loses_nothing():
    """The best direction to a half-space is its normal, everywhere and at all times."""
    solution = GridSolver(HalfSpace(dim=2), 41, estimate=False).solve()
    mean, error = loss_of_holding(solution, solution.problem.horizon / 100)
    assert abs(mean) < 1e-4
    assert error < 1e-4
