"""The estimate of the error of a grid, on problems whose closed forms jump or have layers thinner than a cell."""

from __future__ import annotations

import pytest
import torch
from oracles import Conveyor, late_states
from torch import Tensor

from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.grid import GridSolution, GridSolver
from pirl_rl.grid.estimate import Estimate
from pirl_rl.passages import first_passage
from pirl_rl.problems import HalfSpace
from pirl_rl.scoring.truth import DOUBT


def parts(solution: GridSolution) -> Estimate:
    """The estimate of a solution, with its parts."""
    assert solution.coarse is not None
    return Estimate(solution.field, solution.coarse.field, solution.split, solution.policy, solution.gradient)


class Track(ReachAvoidProblem):
    """Run to x_1 >= 1 at speed 1; only lanes with |x_2| <= 0.3 end in A, and nobody leaves a lane, so that V jumps."""

    horizon = 2.0
    states, controls = Box([-1.0] * 3, [1.0] * 3), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([torch.ones_like(u[..., 0]), torch.zeros_like(u[..., 0]), u[..., 0]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [0.0], [0.1]]).expand(*x.shape, 1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return torch.stack([1 - x[..., 0], x[..., 1].abs() - 0.3], -1)

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return ((x[..., 1].abs() <= 0.3) & (x[..., 0] + tau >= 1)).to(x.dtype)


def test_the_estimate_sees_jumps_that_both_meshes_smear_alike():
    problem = Track()
    tau, x = late_states(problem, 1_000)
    solution = GridSolver(problem, points=25, levels=2).solve()
    assert solution.split
    wrong = (solution.value(tau, x) - problem.exact_value(tau, x)).abs() > 0.1
    assert wrong.sum() > 50
    assert (solution.error(tau, x)[wrong] > DOUBT).all()
    assert (parts(solution).distance(tau, x)[wrong] <= DOUBT).double().mean() > 0.05, "the distance of both would do"


class Shear(ReachAvoidProblem):
    """Run to x_1 >= 1 at speed 1 in lanes with noise of the strength x_2, which nobody leaves."""

    horizon = 2.0
    states, controls = Box([-1.0, 0.02], [1.0, 1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([1 + 0 * u[..., 0], 0 * x[..., 1]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([x[..., 1], 0 * x[..., 1]], -1).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return first_passage(tau, 1 - x[..., 0], 1.0, x[..., 1])


def test_the_estimate_sees_what_upwind_jumps_smear_where_the_noise_is_weak_in_a_part_of_the_box():
    problem = Shear()
    tau, x = late_states(problem, 2_000)
    solution = GridSolver(problem, points=41).solve()
    assert not solution.split
    error = (solution.value(tau, x) - problem.exact_value(tau, x)).abs()
    wrong, estimate = error > 0.1, solution.error(tau, x)
    assert wrong.sum() > 20
    assert (x[wrong, 1] < 0.2).all()
    assert (estimate[wrong] > DOUBT).all()
    assert (parts(solution).distance(tau, x)[wrong] <= DOUBT).double().mean() > 0.05, "the distance of both would do"
    # Where the noise is stronger than that of the jumps, that at single states is the distance alone.
    strong = x[:, 1] > 0.3
    assert (parts(solution).at(tau, x)[strong] < DOUBT).double().mean() > 0.9
    assert (estimate[strong] < DOUBT).double().mean() > 0.85


@pytest.mark.parametrize("count", [41, pytest.param(61, marks=pytest.mark.slow)])
def test_the_estimate_sees_the_middle_of_a_jump_between_nodes(count):
    """V jumps where the way is tau, and no noise acts along the way. In the middle of the jump both meshes have about
    the mean of its sides there, and no curvature, so that the estimate of single states is small."""
    problem = Conveyor()
    tau, x = late_states(problem, 4_000)
    solution = GridSolver(problem, count).solve()
    error = (solution.value(tau, x) - problem.exact_value(tau, x)).abs()
    assert error[parts(solution).at(tau, x) <= DOUBT].max() > 0.06
    assert error[solution.error(tau, x) <= DOUBT].max() < 0.03


def test_the_estimate_of_smooth_values_is_that_of_single_states():
    problem = HalfSpace(dim=2)
    tau, x = late_states(problem, 1_000)
    solution = GridSolver(problem, points=41).solve()
    assert solution.error(tau, x).mean() < 1.5 * parts(solution).at(tau, x).mean()
