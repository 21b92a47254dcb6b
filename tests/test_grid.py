"""The grid solver: closed forms, order, monotonicity, periodic axes, all kinds of noise, the estimate of its error."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracles import Conveyor, late_states
from torch import Tensor

from benchmarks.kinds import Bicycle, Crosswind, Duffing, Gusty, Loiter, Swingup
from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.grid import GridSolution, GridSolver, march
from pirl_rl.grid.candidates import candidates
from pirl_rl.grid.mesh import default_margin, make_mesh, widest_margin
from pirl_rl.passages import first_passage
from pirl_rl.payoffs import LipschitzPayoff
from pirl_rl.problems import (
    CartPole,
    DoubleIntegrator,
    DubinsCar,
    Exit1D,
    HalfSpace,
    Pendulum,
    RadialExit,
    Reach1D,
    Safety1D,
    VehicleDrift3,
)
from pirl_rl.scoring.truth import find_truth
from pirl_rl.structure import is_affine_in


class Skewed(HalfSpace):
    """The half-space in the coordinates z = M x, in which the two channels of the noise are correlated."""

    matrix = torch.tensor([[1.0, 0.6], [0.3, 0.8]], dtype=torch.float64)

    def __init__(self):
        super().__init__(dim=2)
        self.states = Box([-1.5, -1.5], [1.5, 1.5])

    def _original(self, z: Tensor) -> Tensor:
        return z @ self.matrix.inverse().mT.to(z)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u @ self.matrix.mT.to(u)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return self.matrix.to(x).expand(*x.shape, 2)

    def target_level(self, x: Tensor) -> Tensor:
        return super().target_level(self._original(x))

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return HalfSpace(dim=2).exact_value(tau, self._original(x))


class Restless(ReachAvoidProblem):
    """dX = u dW with 0.2 <= u <= 1: reach x >= 1. The most noise is best, and V = 2 Phi(-(1 - x)/sqrt(tau))."""

    horizon = 1.0
    states, controls = Box([-1.0], [1.0]), Box([0.2], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return u.unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 1.0 - x[..., 0]

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return torch.erfc((1 - x[..., 0]).clamp(min=0) / (2 * tau).sqrt())


class Compass(ReachAvoidProblem):
    """d theta = u dt + 0.5 dW on the circle: turn to a heading; the needle sticks opposite to it."""

    horizon = 2.0
    states, controls = Box([-math.pi], [math.pi], periodic=[0]), Box([-1.0], [1.0])

    def __init__(self, heading: float):
        super().__init__()
        self.heading = heading

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u + 0.3 * torch.sin(x - self.heading)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.5 * torch.ones_like(x).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 0.9 - torch.cos(x[..., 0] - self.heading)

    def avoid_level(self, x: Tensor) -> Tensor:
        return torch.cos(x[..., 0] - self.heading) + 0.99


def largest_error(problem: ReachAvoidProblem, count: int) -> float:
    solution = GridSolver(problem, points=count, estimate=False).solve()
    tau, x = late_states(problem)
    return (solution.value(tau, x) - problem.exact_value(tau, x)).abs().max().item()


@pytest.mark.parametrize(
    ("problem", "coarse", "tolerance"),
    [(Reach1D(), 51, 3e-3), (Exit1D(), 51, 3e-3), (Restless(), 51, 3e-3), (HalfSpace(dim=2), 21, 1e-2)],
    ids=lambda value: type(value).__name__,
)
def test_the_error_falls_at_least_as_fast_as_the_mesh(problem, coarse, tolerance):
    """The observed order, from a mesh to one four times as fine, is at least 0.9."""
    errors = [largest_error(problem, count) for count in (coarse, 4 * (coarse - 1) + 1)]
    assert math.log(errors[0] / errors[1], 4) >= 0.9
    assert errors[1] <= tolerance


class Driven(ReachAvoidProblem):
    """Full speed away from a wall: V rises from it as 1 - exp(-2 (x - wall) / s^2), as the horizon is long."""

    states, controls = Box([0.0], [1.0]), Box([-1.0], [1.0])
    horizon, variance = 4.0, 0.04

    def __init__(self, wall: float):
        self.wall = wall

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_full((*x.shape, 1), self.variance**0.5)

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        return x[..., 0] - self.wall


@pytest.mark.parametrize("wall", [0.0, 0.01, 0.04])
def test_a_layer_that_is_thinner_than_a_cell_has_its_values_at_the_nodes(wall):
    """The distance of the nodes is 2.5 widths of the layer. Central or upwind differences are 0.05 to 0.3 off."""
    nodes = torch.arange(1, 19, dtype=torch.float64).unsqueeze(-1) / 20
    solution = GridSolver(Driven(wall), points=21, estimate=False).solve()
    exact = 1 - torch.exp(-2 * (nodes[:, 0] - wall) / Driven.variance)
    assert (solution.value(torch.full((18,), 4.0, dtype=torch.float64), nodes) - exact).abs().max() < 0.01


def test_the_estimate_sees_a_layer_that_is_thinner_than_a_cell():
    """At a 20th of a cell from the wall V is 0.22, and linear between the wall and the first node it is 0.05."""
    x = torch.linspace(0.0025, 0.04, 16, dtype=torch.float64).unsqueeze(-1)
    solution, tau = GridSolver(Driven(0.0), points=21).solve(), torch.full((16,), 4.0, dtype=torch.float64)
    exact = 1 - torch.exp(-2 * x[:, 0] / Driven.variance)
    error = (solution.value(tau, x) - exact).abs()
    assert error.max() > 0.1
    assert (error <= solution.error(tau, x)).all()


@pytest.mark.parametrize("problem", [RadialExit(dim=2), Skewed()], ids=lambda problem: type(problem).__name__)
def test_curved_faces_and_correlated_noise(problem):
    assert largest_error(problem, 81) <= 0.01


class Slanted(ReachAvoidProblem):
    """Reach x_2 >= 1, where x_2 is a Brownian motion with drift; x_1 falls, and its noise is a part of that of x_2."""

    horizon = 5.0
    states, controls = Box([0.0, 0.0], [1.0, 1.0]), Box([-1.0], [1.0])
    speed, sigma = 0.06, (0.02, 0.05)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([-0.054, self.speed]).expand_as(x)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[-0.0125, 0.0], self.sigma]).expand(*x.shape, 2)

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 1]

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        sigma = math.hypot(*self.sigma)
        d, spread = (1 - x[..., 1]).clamp(min=0), sigma * tau.sqrt()
        far = torch.special.log_ndtr((-self.speed * tau - d) / spread) + 2 * self.speed * d / sigma**2
        return torch.special.ndtr((self.speed * tau - d) / spread) + far.exp()


def test_a_drift_across_correlated_noise_adds_no_noise():
    """The offsets of the noise are oblique, by six nodes in x_2; jumps of the drift along them would smear V."""
    problem = Slanted()
    tau, x = late_states(problem)
    solution = GridSolver(problem, points=(21, 81), estimate=False).solve()
    assert (solution.value(tau, x) - problem.exact_value(tau, x)).abs().max() < 0.02


@pytest.mark.parametrize("problem", [Reach1D(), RadialExit(dim=2)], ids=lambda problem: type(problem).__name__)
def test_the_estimate_bounds_the_largest_error(problem):
    solution = GridSolver(problem, points=81).solve()
    tau, x = late_states(problem)
    error = (solution.value(tau, x) - problem.exact_value(tau, x)).abs()
    assert error.max() <= solution.error(tau, x).max()
    assert solution.largest_error < 0.05


def test_the_policy_of_an_invariance_problem_points_inward():
    problem = Safety1D()
    solution = GridSolver(problem, points=101).solve()
    x = torch.linspace(-0.95, 0.95, 40, dtype=torch.float64).unsqueeze(-1)
    assert torch.equal(solution.policy(torch.ones(40), x), -x.sign())
    assert (solution.value(torch.zeros(40), x) == 1).all()


def test_a_larger_target_never_lowers_the_value():
    values = []
    for tolerance in (0.2, 0.3):
        problem = DoubleIntegrator()
        problem.tolerance = tolerance
        solution = GridSolver(problem, points=41, estimate=False).solve()
        axis = torch.linspace(-0.99, 0.99, 33, dtype=torch.float64)
        x = torch.cartesian_prod(axis, axis)
        values.append(solution.value(torch.full((len(x),), 2.0), x))
    # The faces cut the arms of the mesh at other places, so that nodes next to them may move by rounding alone.
    assert (values[1] - values[0]).min() >= -1e-6
    assert all(((value >= 0) & (value <= 1)).all() for value in values)


def test_degenerate_noise_agrees_with_monte_carlo_of_its_own_policy():
    problem = DoubleIntegrator(position_noise=0.0)
    solution = GridSolver(problem, points=81).solve()
    tau, x = (values[:100] for values in late_states(problem))
    played = monte_carlo(problem, solution.policy, tau, x, rollouts=100, dt=0.02)
    # Without noise on the position the scheme is of first order, and its error is that of the estimate. The standard
    # error of one probability is 0.05 at most; that of the mean over 100 states is a tenth of it.
    distance = solution.value(tau, x) - played.probability
    assert abs(distance.mean().item()) < solution.error(tau, x).mean() + 0.01
    assert distance.abs().mean() < solution.error(tau, x).mean() + 0.03


def test_a_turned_problem_on_the_circle_has_the_turned_value():
    """The heading moves by a whole number of nodes, across the seam of the circle."""
    count, moved = 120, 55
    turn = 2 * math.pi * moved / count
    values = []
    for heading in (0.0, turn):
        solution = GridSolver(Compass(heading), points=count, estimate=False).solve()
        angle = torch.linspace(-6.0, 6.0, 101, dtype=torch.float64) + heading
        values.append(solution.value(torch.full((101,), 1.5), angle.unsqueeze(-1)))
    torch.testing.assert_close(values[0], values[1], rtol=0, atol=1e-5)
    # Angles a whole turn apart are one state.
    assert values[0].max() == 1
    assert values[0].min() == 0


class Calming(ReachAvoidProblem):
    """dX = (0.5 + (u - 0.3)^2) dW: stay in |x| < 1. The least noise is best, at u = 0.3 between the common levels."""

    horizon, objective = 1.0, "invariance"
    states, controls = Box([-1.0], [1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.5 + (u - 0.3).square()).unsqueeze(-1)

    def avoid_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0].abs()

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """The eigenfunctions of the interval, sum_k 4/(pi k) sin(k pi (x + 1)/2) exp(-(k pi/4)^2 tau/2), k odd."""
        k = torch.arange(1, 60, 2, dtype=torch.float64)
        wave = torch.sin(k * math.pi * (x + 1) / 2) * 4 / (math.pi * k)
        return (wave * torch.exp(-((k * math.pi / 4) ** 2) * tau.unsqueeze(-1) / 2)).sum(-1)


def test_the_control_is_that_of_the_point_with_the_largest_weight():
    """Some of the states lie beyond the mesh, and across the seam of the circle."""
    problem = DubinsCar()
    solution = GridSolver(problem, points=11, estimate=False).solve()
    rng = torch.Generator().manual_seed(0)
    x = problem.states.expand(1.5).sample(2_000, rng, torch.float64)
    tau = problem.horizon * torch.rand(len(x), generator=rng, dtype=x.dtype)
    corners = [np.stack(entries) for entries in zip(*solution.field.corners(tau, x), strict=True)]
    largest = corners[2].argmax(0)[None]
    expected = [np.take_along_axis(entry, largest, 0)[0] for entry in corners[:2]]
    for nearest, entry in zip(solution.field.nearest(tau, x), expected, strict=True):
        np.testing.assert_array_equal(nearest, entry)


def test_a_control_inside_the_box_may_be_the_best():
    problem = Calming()
    x = torch.linspace(-0.9, 0.9, 19, dtype=torch.float64).unsqueeze(-1)
    tau = torch.ones(19, dtype=torch.float64)
    solution, few = (GridSolver(problem, points=101, levels=levels).solve() for levels in (None, 3))
    torch.testing.assert_close(solution.value(tau, x), problem.exact_value(tau, x), rtol=0, atol=2e-3)
    assert (solution.policy(tau, x) - 0.3).abs().max() < 0.05
    assert (problem.exact_value(tau, x) - few.value(tau, x)).max() > 0.05


class Crowded(ReachAvoidProblem):
    """Four controls move a state together, and a fifth sets its noise alone: reach x >= 1."""

    horizon = 1.0
    states, controls = Box([-1.0], [1.2]), Box([-1.0] * 4 + [0.2], [1.0] * 4 + [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.25 * u[..., :4].sum(-1, keepdim=True)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return u[..., 4:, None]

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]


class Evasive(Crowded):
    """Stay below x = 1."""

    objective = "invariance"

    def avoid_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]


@pytest.mark.parametrize(
    ("problem", "states", "best"),
    [(Crowded(), (-0.5, 0.2), [1.0] * 5), (Evasive(), (0.5, 0.95), [-1.0] * 4 + [0.2])],
)
def test_a_control_of_the_noise_alone_is_found_among_many_controls(problem, states, best):
    """At a distance that the full speed does not cover the most noise is best, and to stay away the least noise is."""
    solution = GridSolver(problem, points=111).solve()
    x = torch.linspace(*states, 12, dtype=torch.float64).unsqueeze(-1)
    policy = solution.policy(torch.full((12,), 0.5, dtype=torch.float64), x)
    torch.testing.assert_close(policy, policy.new_tensor(best).expand(12, 5))


@pytest.mark.parametrize(
    ("problem", "numbers"),
    [(Loiter(), [3, 33]), (Gusty(), [11, 11]), (DubinsCar(), [3]), (VehicleDrift3(), [5, 5]), (Bicycle(), [3, 9])],
)
def test_only_controls_whose_best_value_may_lie_between_their_bounds_have_many_levels(problem, numbers):
    """The drift is affine in the speed of Loiter and of Bicycle while the heading or the wheel stands still."""
    assert [is_affine_in(problem, axis) for axis in range(len(numbers))] == [number == 3 for number in numbers]
    x = problem.states.sample(1, torch.Generator().manual_seed(0), torch.float64).numpy()
    chosen = candidates(problem, x, np.ones(problem.states.dim))[:, 0]
    assert [len(set(column)) for column in chosen.T] == numbers
    assert len(chosen) == math.prod(numbers)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"problem": CartPole()}, "problem: expected at most 3 states for a grid, got 4"),
        ({"problem": Reach1D(), "points": 4}, "points: expected an integer >= 5, or one for each of the 1 axes, got 4"),
        ({"problem": Reach1D(), "steps": 1}, "steps: expected a number >= 2, got 1"),
        ({"problem": Reach1D(), "levels": 1}, "levels: expected a number >= 2, got 1"),
        ({"problem": Reach1D(), "margin": [-1.0]}, r"margin: expected 1 numbers >= 0, got \[-1.0\]"),
    ],
)
def test_arguments_that_are_refused(arguments, message):
    with pytest.raises(ArgumentError, match=message):
        GridSolver(**arguments)


def test_times_and_estimates_that_there_are_not():
    solution = GridSolver(Reach1D(), points=21, estimate=False).solve()
    x = torch.zeros(1, 1)
    with pytest.raises(ArgumentError, match="tau: expected 0 <= tau <= horizon = 2"):
        solution.value(torch.tensor([2.5]), x)
    with pytest.raises(ArgumentError, match="expected a solution with an estimate"):
        solution.error(torch.tensor([1.0]), x)


class Calm(HalfSpace):
    """The half-space with a tenth of the noise: V is the first passage of a Brownian motion with drift over d."""

    sigma = 0.1

    def __init__(self, dim: int = 3):
        super().__init__(dim=dim)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return self.sigma * super().diffusion(x, u)

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        d, c, spread = self.target_level(x).clamp(min=0), self.speed, self.sigma * tau.sqrt()
        ahead, behind = (c * tau - d) / spread, (-c * tau - d) / spread
        reflected = (2 * c * d / self.sigma**2 + torch.special.log_ndtr(behind)).exp()
        return torch.special.ndtr(ahead) + reflected


@pytest.mark.parametrize(
    ("dim", "counts", "bounds"),
    [(2, (33, 49), (0.009, 0.003)), pytest.param(3, (17, 25), (0.018, 0.010), marks=pytest.mark.slow)],
)
def test_weak_noise_has_its_closed_form(dim, counts, bounds):
    """A vertex is the best control, and with three states the layer in which V rises from 0 to 1 is as wide as one cell
    of the coarser mesh. Extrapolation from half the points leaves six tenths of the error at most."""
    problem = Calm(dim)
    tau, x = late_states(problem, 1_000)
    exact = problem.exact_value(tau, x)
    coarser = GridSolver(problem, points=counts[0], levels=2, estimate=False).solve()
    finer = GridSolver(problem, points=counts[1], levels=2).solve()
    assert coarser.split
    assert finer.split
    extrapolated, estimate = (finer.value(tau, x) - exact).abs(), finer.error(tau, x)
    finer.coarse = None
    plain = (finer.value(tau, x) - exact).abs()
    assert (coarser.value(tau, x) - exact).abs().mean() < bounds[0]
    assert plain.mean() < bounds[1]
    assert extrapolated.mean() < 0.6 * plain.mean()
    assert (extrapolated <= estimate + 0.03).all()


class Adrift(ReachAvoidProblem):
    """A current of 1 leads to a wall at x_1 = 1, against a control of at most 1/2; V is the chance not to reach it."""

    objective, horizon, sigma = "invariance", 1.0, 0.1

    def __init__(self, dim: int):
        super().__init__()
        self.states, self.controls = Box([-1.0] * dim, [1.2] * dim), Box([-0.5], [0.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([1 + u, torch.zeros_like(x[..., 1:])], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (self.sigma * torch.eye(x.shape[-1], dtype=x.dtype)).expand(*x.shape, x.shape[-1])

    def avoid_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return 1 - first_passage(tau, self.avoid_level(x), 0.5, self.sigma)


@pytest.mark.parametrize(
    ("problem", "count", "tolerance"),
    [(Calm(1), 101, 0.0008), (Adrift(1), 41, 0.002), (Adrift(2), 41, 0.002)],
)
def test_first_steps_follow_weak_noise_to_its_closed_form(problem, count, tolerance):
    """With plain first steps the errors are 0.0036, 0.009 and 0.008."""
    tau, x = late_states(problem, 1_000)
    solution = GridSolver(problem, points=count).solve()
    assert solution.split
    assert (solution.value(tau, x) - problem.exact_value(tau, x)).abs().mean() < tolerance


class Belt(ReachAvoidProblem):
    """Brownian motion must stay in |x_1| < 1 on a belt along x_2, which is slow and has no noise."""

    horizon, objective = 1.0, "invariance"
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([torch.zeros_like(u), torch.full_like(u, 0.02)], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.5], [0.0]]).expand(*x.shape, 1)

    def avoid_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0].abs()

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return Calming().exact_value(tau, x[..., :1])


def test_first_steps_end_where_the_noise_covers_four_cells_however_slow_the_drift_is():
    """The belt moves by less than two cells in all. With first steps up to the horizon it is 0.004 and 0.038 off."""
    problem = Belt()
    tau, x = late_states(problem, 1_000)
    solution = GridSolver(problem, points=61).solve()
    assert solution.split
    error = (solution.value(tau, x) - problem.exact_value(tau, x)).abs()
    assert error.mean() < 0.0015
    assert error.max() < 0.006


class Landfall(ReachAvoidProblem):
    """Come to x_1 = 1 at a height of at least 0.2 while sinking at the speed 1, so that the largest speed, 2, is best.

    A path comes to x_1 = 1 at a time t with the density of `first_passage`. It succeeds if it is high enough then or at
    a later time. From a height that lacks y, the chance of that is exp(-2 y / s^2), with the strength s of its noise.
    """

    horizon, sigma, fall = 1.0, 0.2, 0.1
    states, controls = Box([0.0, 0.0], [1.0, 1.0]), Box([0.2], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([u, -torch.ones_like(u)], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag(x.new_tensor([self.sigma, self.fall])).expand(*x.shape, 2)

    def target_constraints(self, x: Tensor) -> Tensor:
        return torch.stack([1 - x[..., 0], 0.2 - x[..., 1]], -1)

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        ends = tau * torch.linspace(0, 1, 2_001, dtype=x.dtype)[:, None]
        crossed = first_passage(ends, (1 - x[..., 0]).expand_as(ends), 2.0, self.sigma)
        time = (ends[1:] + ends[:-1]) / 2
        height = (x[..., 1] - 0.2).expand_as(time)
        low = torch.special.ndtr((time - height) / (self.fall * time.sqrt()))
        enough = 1 - 2 * low + first_passage(time, height, 1.0, self.fall)
        return (crossed.diff(dim=0) * enough).sum(0)


def test_a_face_of_the_target_that_paths_leave_is_no_help_to_those_that_cross_another_later():
    """States from which the way takes about the time to go at the largest speed. With the chances of all faces
    multiplied, V is 0.013 too large on average."""
    problem, rng = Landfall(), torch.Generator().manual_seed(0)
    x = problem.states.sample(1_000, rng, torch.float64)
    x = x[x[:, 1] > 0.22]
    spread = torch.rand(len(x), generator=rng, dtype=torch.float64) - 0.5
    tau = ((1 - x[:, 0]) / 2 + 0.1 * spread).clamp(min=0.02)
    solution = GridSolver(problem, points=41).solve()
    assert solution.split
    error = solution.value(tau, x) - problem.exact_value(tau, x)
    assert error.mean().abs() < 0.005
    assert error.abs().mean() < 0.011


def test_a_smoothed_payoff_moves_with_the_flow_in_the_first_steps():
    """It does not jump at tau = 0. With weak noise V is l(d - tau) at the level d, as the flow has the speed 1."""
    problem, tau = Calm(1), 0.02
    problem.payoff = LipschitzPayoff(0.5)
    solution = GridSolver(problem, points=101, estimate=False).solve()
    assert solution.split
    x = torch.linspace(-1.4, 1.4, 57, dtype=torch.float64)[:, None]
    value = solution.value(torch.full((57,), tau, dtype=torch.float64), x)
    assert (value - problem.payoff(problem.target_level(x) - tau)).abs().max() < 0.03


class Stop(ReachAvoidProblem):
    """Come to rest at a place; the noise acts on the speed, whose level is the larger one at most states."""

    horizon = 1.0
    states, controls = Box([-0.1, -1.0], [0.1, 1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([x[..., 1], u[..., 0]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [0.6]]).expand(*x.shape, 1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return torch.stack([x[..., 0].abs() - 0.015, x[..., 1].abs() - 0.15], -1)


def test_a_target_of_several_faces_is_entered_through_all_of_them():
    """Noise soon brings the speed into its band, but not the place, which is a time of 0.18 away at a speed of 0.25."""
    solution = GridSolver(Stop(), points=21, steps=150, estimate=False).solve()
    assert solution.split
    speed = torch.linspace(-0.25, 0.25, 11, dtype=torch.float64)
    value = solution.value(torch.full((11,), 0.05, dtype=torch.float64), torch.stack([0 * speed + 0.06, speed], -1))
    assert value.max() < 0.02


class Landing(ReachAvoidProblem):
    """Land softly: 0 < height <= 0.2 at a speed of at most 0.8. The noise is weak, and gusts act on the speed alone."""

    horizon = 5.0
    states, controls = Box([0.0, -3.0], [6.0, 3.0]), Box([0.0], [15.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([x[..., 1], u[..., 0] - 9.81], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [0.6]]).expand(*x.shape, 1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return torch.stack([x[..., 0] - 0.2, -0.8 - x[..., 1], x[..., 1] - 0.8], -1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., :1]


def test_a_target_of_few_nodes_is_pointed_out_since_the_estimate_misses_its_error():
    """With 61 nodes two rows are in the target. Its own policy nearly always lands, where the grid finds 0.94."""
    problem = Landing()
    with pytest.warns(UserWarning, match="fewer than 4 nodes in a row along an axis with points=\\(61, 61\\)"):
        solution = GridSolver(problem, points=61).solve()
    tau, x = torch.full((3,), 3.5, dtype=torch.float64), torch.tensor([[1.0, -1.0], [1.5, 0.0], [3.0, 0.0]]).double()
    played = monte_carlo(problem, solution.policy, tau, x, rollouts=200, dt=0.01, seed=0).probability
    assert (played - solution.value(tau, x) > 4 * solution.error(tau, x)).all()
    assert find_truth(problem, 10, 0, {2: 61}).source == "none"


class Slit(Reach1D):
    """A target that is seen at three quarters of the way between two nodes, and between no nodes twice as far apart."""

    states = Box([-1.0], [1.0])

    def target_level(self, x: Tensor) -> Tensor:
        return (x[..., 0] - 0.0375).abs() - 0.004


def test_a_solution_whose_half_mesh_misses_the_target_is_kept_and_its_error_is_unknown(tmp_path):
    tau, x = late_states(Slit(), 50)
    with pytest.warns(UserWarning, match="the error of the grid is not known, and its estimate is 1"):
        solution = GridSolver(Slit(), points=41).solve()
    assert torch.equal(solution.value(tau, x), GridSolver(Slit(), points=41, estimate=False).solve().value(tau, x))
    solution.save(tmp_path / "grid.npz")
    for kept in (solution, GridSolution.load(tmp_path / "grid.npz", Slit())):
        assert (kept.error(tau, x) == 1).all()
        assert kept.largest_error == 1


class Broad(ReachAvoidProblem):
    """Brownian motion whose noise is three times as wide as the box: V = 2 Phi(-(1 - x)/(3 sqrt(tau)))."""

    horizon = 1.0
    states, controls = Box([0.0], [1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.full_like(x, 3.0).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return first_passage(tau, 1 - x[..., 0], 0.0, 3.0)


class Swept(Broad):
    """A current sweeps every path into x >= 3 in time, beyond the mesh, which ends one width beside the box: V = 0."""

    objective = "invariance"

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.full_like(x, 5.0)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.full_like(x, 0.3).unsqueeze(-1)

    def avoid_level(self, x: Tensor) -> Tensor:
        return 3 - x[..., 0]

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return torch.zeros_like(tau)


@pytest.mark.parametrize("problem", [Broad(), Swept()], ids=lambda problem: type(problem).__name__)
def test_a_margin_that_was_limited_is_pointed_out_and_counts_in_the_estimate_where_it_changes_the_value(problem):
    x = torch.linspace(0.05, 0.95, 19, dtype=torch.float64).unsqueeze(-1)
    tau = torch.ones(19, dtype=torch.float64)
    with pytest.warns(UserWarning, match=r"margin: the mesh goes beyond .* by \[1.0\]; .* expected margin=\["):
        solution = GridSolver(problem, points=101).solve()
    error = (solution.value(tau, x) - problem.exact_value(tau, x)).abs()
    assert error.max() > 0.1
    assert (error <= solution.error(tau, x) + 0.01).all()
    wide = GridSolver(problem, points=101, margin=default_margin(problem).tolist()).solve()
    assert (wide.value(tau, x) - problem.exact_value(tau, x)).abs().max() < 0.01


@pytest.mark.parametrize(
    ("problem", "count", "resolved"),
    [
        (Landing(), 91, False),  # rows at 0.07, 0.13 and perhaps 0.2
        (Landing(), 151, True),
        (HalfSpace(dim=2), 5, True),  # goes on beyond the mesh
        (DubinsCar(), 61, True),  # a disc at all headings, which are periodic
        (DubinsCar(), 13, False),
        (Pendulum(), 5, True),  # there is no target
    ],
)
def test_a_target_is_resolved_by_four_nodes_in_a_row(problem, count, resolved):
    assert GridSolver(problem, points=count).resolves_target is resolved


class Hasty(Landfall):
    """A `Landfall` whose height has so much noise that only the largest speed is large beside the noise."""

    sigma, fall = 0.25, 1.0


@pytest.mark.parametrize(
    ("problem", "split"),
    [
        (DubinsCar(), True),
        (HalfSpace(dim=3), False),
        (Calm(2), True),
        (Duffing(), True),
        (Swingup(), True),
        (Hasty(), True),
    ],
)
def test_drift_and_noise_act_in_turns_where_the_noise_is_weak(problem, split):
    """The forces of Duffing and Swingup grow in the margin of the mesh, where they ask for no shorter steps. The noise
    of Hasty is weak beside its largest speed alone, which is not that of the first candidate."""
    assert GridSolver(problem, points=11, estimate=False).solve().split == split
    assert not GridSolver(problem, points=11, estimate=False, turns=False).solve().split


@pytest.mark.parametrize(
    ("count", "mean", "largest"), [(61, 0.004, 0.03), pytest.param(121, 0.001, 0.01, marks=pytest.mark.slow)]
)
def test_noise_that_depends_on_the_control_acts_in_turns_with_the_drift(count, mean, largest):
    """V jumps where the way is tau. If both act together it is smeared, and with 61 nodes wrong by up to 0.34 at these
    states. The policy is judged where V is below 1, since elsewhere slower controls are as good."""
    problem = Conveyor()
    solution = GridSolver(problem, count, estimate=False).solve()
    tau, x = late_states(problem)
    away = (1 - x[:, 0] - tau).abs() > 0.05
    exact = problem.exact_value(tau, x)
    error = (solution.value(tau, x) - exact).abs()[away]
    assert error.mean() < mean
    assert error.max() < largest
    decides = away & (1 - x[:, 0] < tau) & (exact < 1 - 1e-4)
    assert (solution.policy(tau, x)[decides, 0] == 1).double().mean() > 0.95


@pytest.fixture(scope="module")
def dubins() -> GridSolution:
    return GridSolver(DubinsCar(), points=31, estimate=False).solve()


def test_the_dubins_car_agrees_with_monte_carlo_of_its_own_policy(dubins):
    """With 100 paths from each of 60 states a perfect V would have about 0.016."""
    problem, solution = dubins.problem, dubins
    tau, x = (values[:60] for values in late_states(problem))
    played = monte_carlo(problem, solution.policy, tau, x, rollouts=100, dt=0.04)
    assert (solution.value(tau, x) - played.probability).abs().mean() < 0.035


def test_v_rises_from_a_wall_that_paths_leave(dubins):
    """Next to a wall V changes within a layer that is far thinner than a cell, as 1 - exp(-2 v d/sigma^2) at d."""
    problem, solution = dubins.problem, dubins
    distance = torch.tensor([0.0034, 0.01, 0.05, 0.1], dtype=torch.float64)
    away = torch.stack([distance - problem.wall, 0 * distance, 0 * distance], -1)
    tau = torch.full((4,), 4.0, dtype=torch.float64)
    value = solution.value(tau, away)
    played = monte_carlo(problem, solution.policy, tau, away, rollouts=250, dt=0.02)
    assert (value - played.probability).abs().max() < 0.1
    layer = 1 - (-2 * problem.speed * distance / problem.noise[0] ** 2).exp()
    assert (value / value[-1] - layer)[:2].abs().max() < 0.01


def test_noise_saves_paths_that_the_flow_leads_into_a_wall(dubins):
    """A car that meets a wall at a small angle may be pushed off it: without noise V would be 0.

    With 500 paths from each of 20 states a perfect V would have a mean error of about 0.014.
    """
    problem, solution = dubins.problem, dubins
    distance = torch.linspace(0.02, 0.08, 20, dtype=torch.float64)
    angle = torch.linspace(0.25, 0.6, 20, dtype=torch.float64)  # rad, between the heading and the wall x_1 = 2
    x = torch.stack([problem.wall - distance, torch.full_like(angle, -1.2), math.pi / 2 - angle], -1)
    tau = torch.full((20,), 2.5, dtype=torch.float64)
    value = solution.value(tau, x)
    played = monte_carlo(problem, solution.policy, tau, x, rollouts=500, dt=0.005).probability
    assert (value - played).abs().mean() < 0.03


def test_noise_two_integrators_away_agrees_with_monte_carlo_of_its_own_policy():
    """V jumps, and is 1 in whole regions, where many controls are as good; a policy that takes any of them fails.

    With 100 paths from each state a perfect V would have about 0.015. The chain alone smears V, as it does where the
    steps are too long for drift and noise to act in turns.
    """
    problem, distances = Crosswind(), {}
    tau, x = (values[:100] for values in late_states(problem))
    for steps in (None, 21):
        solution = GridSolver(problem, points=21, steps=steps, estimate=False).solve()
        played = monte_carlo(problem, solution.policy, tau, x, rollouts=100, dt=0.025)
        distances[solution.split] = solution.value(tau, x) - played.probability
    assert distances[True].abs().mean() < 0.065
    assert distances[True].abs().mean() < distances[False].abs().mean() / 2
    # The problem is its own mirror image.
    left, right = x[:, 0] < -0.2, x[:, 0] > 0.2
    assert abs(distances[True][left].mean() - distances[True][right].mean()) < 0.07


class Tank(ReachAvoidProblem):
    """Torricelli's law: fill a leaking tank before it is empty. Below its bottom the drift has no value."""

    horizon = 4.0
    states, controls = Box([0.0], [2.0]), Box([0.0], [0.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u - 0.3 * x.sqrt()

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.full_like(x, 0.02).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 1.5 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        return x[..., 0]


def test_a_drift_without_a_value_in_a_set_is_not_asked_there():
    """From 1.2 m the tank fills at 0.14 m/s or more, and needs 2.3 s at most for 0.3 m; it is never filled in 0.5 s."""
    solution = GridSolver(Tank(), 201).solve()
    x = torch.linspace(0.02, 1.48, 60, dtype=torch.float64).unsqueeze(-1)
    for tau in (0.5, 4.0):
        value = solution.value(torch.full((60,), tau, dtype=torch.float64), x)
        assert value.isfinite().all()
        assert (value.diff() > -1e-3).all()
        assert (value[x[:, 0] < 1.2] < 0.01).all() if tau == 0.5 else (value[x[:, 0] > 1.2] > 0.99).all()


class Walled(ReachAvoidProblem):
    """Come to x >= 0.5 with weak noise. Below the box a force grows beyond 1e9; it counts how often it is asked for."""

    horizon, asked = 1.0, 0
    states, controls = Box([-1.0], [1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        self.asked += 1
        assert self.asked < 50_000
        return u + (20 * (-1 - x)).exp()

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.05 + 0 * x).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 0.5 - x[..., 0]


def test_a_large_force_in_the_margin_does_not_ask_for_steps_without_end():
    """To follow the force would take more than 1e9 looks in a step. In the box V is a first passage at the speed 1."""
    solution = GridSolver(Walled(), points=101).solve()
    assert solution.split
    x = torch.linspace(-0.8, 0.45, 40, dtype=torch.float64).unsqueeze(-1)
    tau = torch.ones(40, dtype=torch.float64)
    error = (solution.value(tau, x) - first_passage(tau, 0.5 - x[:, 0], 1.0, 0.05)).abs()
    assert error.mean() < 0.005
    assert (error <= solution.error(tau, x) + 0.01).all()


class Bottomless(ReachAvoidProblem):
    """The tank without a set below its bottom, where neither drift nor noise has a number."""

    horizon, controls = 4.0, Box([0.0], [0.5])
    drift, target_level = Tank.drift, Tank.target_level

    def __init__(self, low: float):
        super().__init__()
        self.states = Box([low], [2.0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.02 + 0 * x.sqrt()).unsqueeze(-1)


@pytest.mark.parametrize(("low", "points", "turns"), [(-0.2, 221, True), (-0.2, 221, False), (0.1, 191, True)])
def test_paths_fail_where_the_physics_has_no_numbers(low, points, turns):
    """The tank has the same V as one with an avoid set below its bottom, which is in the box or in its margin."""
    x = torch.linspace(0.02, 1.48, 60, dtype=torch.float64).unsqueeze(-1)
    tau = torch.full((60,), 4.0, dtype=torch.float64)
    kept = GridSolver(Tank(), 201, turns=turns).solve()
    lost = GridSolver(Bottomless(low), points, turns=turns).solve()
    assert kept.split == lost.split == turns
    assert (lost.value(tau, x) - kept.value(tau, x)).abs().max() < 0.01
    assert (lost.value(tau, x - 1.6) < 0.01).all()
    assert lost.policy(tau, x).isfinite().all()


class Along(ReachAvoidProblem):
    """Motion along the face of the target, with noise across it that is weak beside the mesh."""

    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([torch.ones_like(u), 0.01 * u], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [0.01]]).expand(*x.shape, 1)

    def target_level(self, x: Tensor) -> Tensor:
        return 0.49 - x[..., 1]


@pytest.mark.parametrize("tau", [0.0, 0.01, 0.5])
def test_a_path_that_runs_out_of_time_beside_a_face_has_its_payoff(tau):
    """V at a fifth to four fifths of a cell before the face is the first passage of Brownian motion with drift."""
    problem = Along(horizon=1.0)
    solution = GridSolver(problem, points=41, estimate=False).solve()
    assert solution.split
    distance = 0.05 * torch.tensor([0.2, 0.4, 0.6, 0.8], dtype=torch.float64)
    x = torch.stack([torch.full_like(distance, -0.5), 0.49 - distance], -1)
    exact = first_passage(torch.full_like(distance, tau), distance, 0.01, 0.01) if tau else torch.zeros_like(distance)
    assert (solution.value(torch.full_like(distance, tau), x) - exact).abs().max() < 0.03


def test_a_margin_does_not_lengthen_a_period():
    class Turning(ReachAvoidProblem):
        states, controls = Box([-math.pi], [math.pi], periodic=[0]), Box([-1.0], [1.0])

        def drift(self, x: Tensor, u: Tensor) -> Tensor:
            return u

        def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
            return (0.5 + 0 * x).unsqueeze(-1)

        def target_level(self, x: Tensor) -> Tensor:
            return math.pi - 0.5 - x[..., 0].abs()  # the half turn

    problem, x = Turning(horizon=1.0), torch.linspace(-3, 3, 9, dtype=torch.float64).unsqueeze(-1)
    tau = torch.ones(len(x), dtype=torch.float64)
    plain, wide = (GridSolver(problem, 81, margin=margin).solve().value(tau, x) for margin in (None, [0.3]))
    assert torch.equal(plain, wide)


class Tilting(ReachAvoidProblem):
    """Three states with bounds that nodes meet, up to rounding, and beyond which lies the avoid set."""

    objective = "invariance"
    horizon = 4.0
    states, controls = Box([-0.5, -2.5, -2.0], [0.5, 2.5, 2.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([x[..., 1], u[..., 0], u[..., 0]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [1.0], [0.0]]).expand(*x.shape, 1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1 - (x / x.new_tensor([0.5, 2.5, 2.0])).abs()


@pytest.mark.parametrize("points", [9, 16, 21, 26, 41])
def test_a_wider_margin_leaves_a_mesh_as_it_is_where_all_beyond_it_is_in_a_set(points):
    """Also where nodes lie on the faces: they are the same ones to the last bit, whatever the margin is."""
    problem, meshes = Tilting(), []
    for margin in (widest_margin(problem), 2 * widest_margin(problem), 0.13 * widest_margin(problem)):
        meshes.append(make_mesh(problem, (points,) * 3, margin))
    assert len({mesh.shape for mesh in meshes}) == 1
    nodes = [mesh.states(mesh.indices()) for mesh in meshes]
    assert all(np.array_equal(other, nodes[0]) for other in nodes)


@pytest.fixture(scope="module")
def half_space_in_three_dimensions() -> GridSolution:
    return GridSolver(HalfSpace(dim=3), 9, estimate=False).solve()


def test_an_iteration_that_breaks_down_at_its_solution_has_solved_the_step(half_space_in_three_dimensions, monkeypatch):
    """Where the residual vanishes the method divides 0 by 0, and reports a failure."""
    bicgstab = march.bicgstab
    monkeypatch.setattr(march, "bicgstab", lambda *args, **options: (bicgstab(*args, **options)[0], -10))
    solution = GridSolver(HalfSpace(dim=3), 9, estimate=False).solve()
    assert np.array_equal(solution.field.values, half_space_in_three_dimensions.field.values)


def test_a_step_in_three_dimensions_that_the_iteration_cannot_solve_is_taken_in_two(
    half_space_in_three_dimensions, monkeypatch
):
    """The error of V, of which that of the steps is a part, does not grow."""
    bicgstab, calls = march.bicgstab, []

    def fails_at_whole_steps(matrix, right, guess, **options):
        calls.append(len(calls) % 3)
        value, failed = bicgstab(matrix, right, guess, **options)
        return (np.zeros_like(value), 1000) if calls[-1] == 0 else (value, failed)

    monkeypatch.setattr(march, "bicgstab", fails_at_whole_steps)
    solution = GridSolver(HalfSpace(dim=3), 9, estimate=False).solve()
    assert calls == [0, 1, 2] * (len(calls) // 3)
    tau, x = late_states(HalfSpace(dim=3))
    exact = HalfSpace(dim=3).exact_value(tau, x)
    halves, whole = ((grid.value(tau, x) - exact).abs().mean() for grid in (solution, half_space_in_three_dimensions))
    assert 0 < halves < whole
