"""The filter of nominal controllers, on problems whose value and optimal control are known in closed form."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from oracles import FullNoise
from torch import Tensor

from pirl_rl import ReachAvoidFilter
from pirl_rl.certificates import lower_bound, upper_bound
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.filters import MODES, nearest_action, values_ahead
from pirl_rl.grid import GridSolver
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.operators import generator
from pirl_rl.passages import first_passage
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import DubinsCar, Exit1D, HalfSpace, Pendulum, PlanarQuadrotor, Reach1D, VehicleDrift
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution
from pirl_rl.structure import is_control_affine


class Exact(Solution):
    """The exact value and an optimal policy of a problem, in double precision."""

    dtype, device = torch.float64, torch.device("cpu")

    def __init__(self, problem: ReachAvoidProblem):
        self.problem = problem

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.problem.exact_value(tau, x)

    def policy(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.problem.optimal_control(tau, x)

    def residual(self, tau: Tensor, x: Tensor, u: Tensor | None = None) -> Tensor:
        return generator(self.value, self.problem, tau, x, self.policy(tau, x) if u is None else u)


class Still(Exact):
    """The value of the control 0 in a half-space: L^u V = (a . u) V', so that L^u V >= 0 where a . u >= 0."""

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        return first_passage(tau, 1.0 - x @ x.new_tensor(self.problem.normal), drift=0.0)


def networks(problem: ReachAvoidProblem) -> Solution:
    torch.manual_seed(0)
    return Solution(problem, Actor(problem, (16,)), stack([Critic(problem, (16, 16), output="Sigmoid")]))


def uncertain(problem: ReachAvoidProblem, count: int = 300) -> tuple[Tensor, Tensor]:
    """Times to go in the second half of the horizon and states with 0.2 < V < 0.98."""
    rng = torch.Generator().manual_seed(0)
    x = problem.states.expand(1.5).sample(20 * count, rng, torch.float64)
    tau = problem.horizon * (0.5 + 0.5 * torch.rand(len(x), generator=rng, dtype=torch.float64))
    value = problem.exact_value(tau, x)
    chosen = problem.interior(x) & (value > 0.2) & (value < 0.98)
    return tau[chosen][:count], x[chosen][:count]


def reversed_policy(problem: ReachAvoidProblem):
    return lambda tau, x: -problem.optimal_control(tau, x)


PROBLEMS = [Reach1D(), Exit1D(), HalfSpace(dim=2)]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("problem", PROBLEMS, ids=lambda problem: type(problem).__name__)
def test_the_optimal_control_passes(problem, mode):
    tau, x = uncertain(problem)
    filtered = ReachAvoidFilter(Exact(problem), problem.optimal_control, 0.9, mode, simulator=Simulator(problem, 0.005))
    # sup L^u V = 0 at the bound of the box, where rounding may ask for a last digit of the control.
    assert torch.allclose(filtered(tau, x), problem.optimal_control(tau, x), atol=1e-9)


def test_the_mean_ahead_is_exact_for_cubic_values():
    """E (a . X)^3 = m^3 + 3 m h |a|^2 with m = a . (x + u h), for three channels of noise."""
    problem, h = HalfSpace(dim=3), 0.1

    class Cubic(Exact):
        def value(self, tau, x):
            return x.sum(-1) ** 3

    x, u = (torch.linspace(-1, 1, 15, dtype=torch.float64).reshape(5, 3) * scale for scale in (1.0, 0.3))
    ahead = values_ahead(Cubic(problem), Simulator(problem, h), torch.ones(5, dtype=torch.float64), x, u)
    assert ahead.shape == (6, 5)
    m = (x + u * h).sum(-1)
    assert torch.allclose(ahead.mean(0), m**3 + 9 * m * h, rtol=1e-12)


def test_the_last_step_ends_at_the_indicator():
    problem = Reach1D()
    tau, x = torch.tensor([0.01], dtype=torch.float64), torch.tensor([[1.95]], dtype=torch.float64)
    ahead = values_ahead(Exact(problem), Simulator(problem, 0.1), tau, x, torch.zeros_like(x))
    assert ahead[:, 0].tolist() == [1.0, 0.0]  # at 1.95 + 0.1 and 1.95 - 0.1


def test_a_control_is_replaced_when_success_after_the_step_falls_below_p():
    """Against Gauss-Hermite quadrature with 40 nodes; the rule of two nodes errs by h^2 V''''/12, below 1e-4 here."""
    problem, h, p = Reach1D(), 0.02, 0.7
    tau, x = uncertain(problem, 2_000)
    filtered = ReachAvoidFilter(
        Exact(problem), reversed_policy(problem), p, "least_restrictive", simulator=Simulator(problem, h)
    )
    nodes, weights = (torch.as_tensor(entry) for entry in np.polynomial.hermite_e.hermegauss(40))
    ahead = problem.exact_value((tau - h)[:, None], (x - h + h**0.5 * nodes).unsqueeze(-1)) @ weights / weights.sum()
    clear = (ahead - p).abs() > 1e-4
    assert clear.double().mean() > 0.99
    expected = torch.where(ahead > p, -1.0, 1.0).double()
    assert 0.2 < (expected > 0).double().mean() < 0.8
    assert torch.equal(filtered(tau, x)[clear, 0], expected[clear])
    assert torch.equal(filtered.correct(tau, x, -torch.ones_like(x))[1], filtered(tau, x)[:, 0] > 0)


def successes(problem, policy, tau: float, x: list[float], dt: float, paths: int) -> int:
    start = torch.full((1,), tau, dtype=torch.float64), torch.tensor([x], dtype=torch.float64)
    simulator, rng = Simulator(problem, dt, compile=False), torch.Generator().manual_seed(0)
    return round(mean_payoff(simulator, policy, *start, paths, rng).item() * paths)


@pytest.mark.parametrize(("problem", "x"), [(Reach1D(), [1.6]), (Exit1D(), [0.8])])
def test_the_power_of_v_bounds_success_on_whole_paths(problem, x):
    """10,000 paths under the reversed control: success is above V^k and below V, at the level of 0.9999."""
    paths, dt = 10_000, problem.horizon / 50
    filtered = ReachAvoidFilter(
        Exact(problem), reversed_policy(problem), 0.7, "submartingale", simulator=Simulator(problem, dt)
    )
    value = problem.exact_value(torch.tensor(problem.horizon), torch.tensor(x)).item()
    won = successes(problem, filtered, problem.horizon, x, dt, paths)
    assert upper_bound(won, paths, 0.9999) > value**filtered.rule.exponent
    assert lower_bound(won, paths, 0.9999) < value
    without = successes(problem, reversed_policy(problem), problem.horizon, x, dt, paths)
    assert upper_bound(without, paths, 0.9999) < value**filtered.rule.exponent


def test_the_power_of_v_is_p_at_the_margin():
    for p, start in ((0.9, 0.95), (0.5, 0.55), (0.98, 0.99)):
        rule = ReachAvoidFilter(Exact(Reach1D()), None, p, "submartingale", simulator=Simulator(Reach1D())).rule
        assert start**rule.exponent == pytest.approx(p, rel=1e-12)


def test_one_step_ahead_does_not_bound_whole_paths():
    """From V = 0.75 with p = 0.7, success is below p, although each step keeps to its condition."""
    problem, dt, paths = Exit1D(), 0.02, 4_000
    x = torch.linspace(0, 1, 10_001, dtype=torch.float64).unsqueeze(-1)
    start = x[(problem.exact_value(torch.ones(1), x) - 0.75).abs().argmin()].tolist()
    filtered = ReachAvoidFilter(
        Exact(problem), reversed_policy(problem), 0.7, "least_restrictive", simulator=Simulator(problem, dt)
    )
    assert upper_bound(successes(problem, filtered, 1.0, start, dt, paths), paths, 0.9999) < 0.7


@pytest.mark.parametrize("m", [1, 2, 3])
def test_the_nearest_action_is_that_of_a_search_over_a_grid(m):
    """No point of a fine grid meets the constraint and is nearer, over random c, g and a, some entries of g being 0."""
    rng, count = torch.Generator().manual_seed(m), 400
    action = 2 * torch.rand(count, m, generator=rng, dtype=torch.float64) - 1
    action[::3] = action[::3].sign()
    slope = torch.randn(count, m, generator=rng, dtype=torch.float64) * torch.rand(count, m, generator=rng).gt(0.15)
    slope = slope * 10 ** (4 * torch.rand(count, 1, generator=rng, dtype=torch.float64) - 2)
    offset = slope.abs().sum(-1) * (3 * torch.rand(count, generator=rng, dtype=torch.float64) - 2)
    nearest, moved = nearest_action(action, offset, slope)
    ticks = torch.linspace(-1, 1, {1: 2_001, 2: 101, 3: 31}[m], dtype=torch.float64)
    grid = torch.tensor([*itertools.product(ticks.tolist(), repeat=m)], dtype=torch.float64)
    rates, rounding = offset + grid @ slope.mT, 1e-9 * (1 + slope.abs().sum(-1))
    distance = (grid[:, None] - action).norm(dim=-1).masked_fill(rates < rounding, torch.inf).amin(0)
    rate, best = offset + (nearest * slope).sum(-1), rates.amax(0)  # the best vertex is a point of the grid
    feasible = best >= 0
    assert 0.5 < feasible.double().mean() < 1
    assert (nearest.abs() <= 1).all()
    assert (rate >= -rounding)[feasible].all()
    assert ((nearest - action).norm(dim=-1) <= distance + 1e-9)[feasible].all()
    assert torch.allclose(rate[~feasible], best[~feasible], atol=1e-9)
    assert torch.equal(nearest[~moved], action[~moved])
    assert torch.equal(moved, offset + (action * slope).sum(-1) < 0)


def test_the_smallest_change_projects_onto_the_half_space_of_controls():
    """With the value of the control 0, {L^u V >= 0} = {a . u >= 0}; the projection is u - min(a . u, 0) a by hand."""
    problem = HalfSpace(dim=2)
    normal = torch.tensor(problem.normal, dtype=torch.float64)
    tau, x = uncertain(problem)
    u = problem.controls.sample(len(x), torch.Generator().manual_seed(1), torch.float64)
    projected = u - (u @ normal).clamp(max=0).unsqueeze(-1) * normal
    inside = problem.controls.contains(projected)
    control, moved = ReachAvoidFilter(Still(problem), mode="smallest_change", simulator=Simulator(problem)).correct(
        tau, x, u
    )
    assert inside.double().mean() > 0.5
    assert torch.allclose(control[inside], projected[inside], atol=1e-9)
    assert torch.equal(moved, u @ normal < 0)
    assert (control @ normal > -1e-9).all()


def test_the_smallest_change_of_a_network_is_that_of_a_search_over_controls():
    """Two controls, 101 levels each: no control with L^u V >= 0 is nearer than that of the filter."""
    problem = PlanarQuadrotor()
    solution, rng = networks(problem), torch.Generator().manual_seed(2)
    x, u = problem.states.sample(20, rng), problem.controls.sample(20, rng)
    tau = torch.full((20,), 1.0)
    filtered = ReachAvoidFilter(solution, mode="smallest_change", simulator=Simulator(problem))
    control = filtered.correct(tau, x, u)[0]
    ticks = torch.linspace(-1, 1, 101)
    grid = torch.cartesian_prod(ticks, ticks)
    action, nominal = problem.controls.normalize(control), problem.controls.normalize(u)
    for index in range(20):
        many = tau[index].expand(len(grid)), x[index].expand(len(grid), -1)
        rate = solution.residual(*many, problem.controls.denormalize(grid))
        distance = (grid - nominal[index]).norm(dim=-1)
        here = solution.residual(*(entry[index : index + 1] for entry in (tau, x, control)))
        tolerance = 1e-4 * rate.abs().max()  # single precision
        if rate.max() > tolerance:
            assert here > -tolerance
            assert (action[index] - nominal[index]).norm() <= distance[rate >= tolerance].min() + 1e-4
        else:
            assert here >= rate.max() - tolerance


@pytest.mark.parametrize("mode", MODES)
def test_single_calls_batches_numpy_and_torch_agree(mode):
    problem = Pendulum()
    solution = networks(problem)
    nominal = lambda tau, x: problem.controls.denormalize(torch.cos(9 * x[:, :1]))  # noqa: E731
    filtered = ReachAvoidFilter(solution, nominal, 0.5, mode, simulator=Simulator(problem, 0.05))
    x = problem.states.sample(24, torch.Generator().manual_seed(3)).reshape(4, 6, 2)
    together = filtered(1.5, x)
    assert together.shape == (4, 6, 1)
    from_numpy = filtered(1.5, x.numpy())
    assert isinstance(from_numpy, np.ndarray)
    assert np.array_equal(from_numpy, together.numpy())
    alone = torch.stack([filtered(1.5, row) for row in x.reshape(-1, 2)])
    # Products of matrices of other sizes round differently, also where the constraint is divided by a small slope.
    assert torch.allclose(alone, together.reshape(-1, 1), atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_compiled_calls_agree(mode):
    problem = DubinsCar()
    filters = [
        ReachAvoidFilter(
            networks(problem), problem.controls.denormalize, 0.5, mode, simulator=Simulator(problem), compile=compiled
        )
        for compiled in (False, True)
    ]
    for x in problem.states.sample(20, torch.Generator().manual_seed(3)):
        u = torch.tensor([0.3])
        (eager, refused), (fast, also) = (one.correct(1.0, x, u) for one in filters)
        assert torch.allclose(eager, fast, atol=1e-3)
        assert torch.equal(refused, also)


def test_which_drifts_are_affine():
    assert all(is_control_affine(problem) for problem in (Reach1D(), Pendulum(), PlanarQuadrotor(), DubinsCar()))
    assert not is_control_affine(VehicleDrift())
    assert not is_control_affine(FullNoise(2, 1, 2))  # sigma depends on u


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"p": 1.0}, "p: expected a probability between 0 and 1, got 1.0"),
        ({"p": True}, "p: expected a probability"),
        ({"mode": "nope"}, "mode: expected one of submartingale, least_restrictive, smallest_change, got 'nope'"),
        ({"nominal": 3}, "nominal: expected a function"),
        ({"run_or_solution": 3}, "run_or_solution: expected a run or a solution, got 3"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    given = {"run_or_solution": Exact(Reach1D()), "nominal": Reach1D().optimal_control} | arguments
    with pytest.raises(ArgumentError, match=message):
        ReachAvoidFilter(**given)


def test_calls_that_make_no_sense_are_refused():
    filtered = ReachAvoidFilter(Exact(Reach1D()), simulator=Simulator(Reach1D()))
    with pytest.raises(ArgumentError, match="nominal: expected a controller, got None"):
        filtered(1.0, np.zeros((3, 1)))
    with pytest.raises(ArgumentError, match=r"u: expected controls in Box\(\[-1.0\], \[1.0\]\), got \[2.0\]"):
        filtered.correct(1.0, np.zeros((3, 1)), np.full((3, 1), 2.0))
    with pytest.raises(ArgumentError, match="0 <= tau <= horizon = 2"):
        filtered.correct(3.0, np.zeros((3, 1)), np.zeros((3, 1)))


def test_the_smallest_change_refuses_what_it_cannot_serve():
    noisy = FullNoise(2, 1, 2)
    with pytest.raises(ArgumentError, match=r"mode: expected a drift that is affine in u.*got those of FullNoise"):
        ReachAvoidFilter(networks(noisy), mode="smallest_change", simulator=Simulator(noisy))
    grid = GridSolver(Exit1D(), 21).solve()
    with pytest.raises(ArgumentError, match=r"mode: expected a value with second derivatives.*got a GridSolution"):
        ReachAvoidFilter(grid, mode="smallest_change", simulator=Simulator(Exit1D()))
    assert ReachAvoidFilter(grid, Exit1D().optimal_control, simulator=Simulator(Exit1D()))(1.0, [[0.0]]) == 1.0
