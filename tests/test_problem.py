"""The problem: its checks, what its sets say together, and the shipped problems' own facts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import PROBLEMS, SHIPPED, Corner, FullNoise, name
from torch import Tensor

from pirl_rl.checking import examine
from pirl_rl.constants import constant
from pirl_rl.errors import ArgumentError, ProblemError
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.operators import generator
from pirl_rl.payoffs import LipschitzPayoff
from pirl_rl.problem import ReachAvoidProblem, closed_form
from pirl_rl.problems import (
    DoubleIntegrator,
    DubinsCar,
    Exit1D,
    HalfSpace,
    Pendulum,
    RadialExit,
    Reach1D,
    Safety1D,
    ZermeloBoat,
)
from pirl_rl.sets import Box
from pirl_rl.structure import check_problem, has_controlled_noise

GOLDEN = np.load(Path(__file__).parent / "data" / "reach1d_value.npz")


def sample(problem: ReachAvoidProblem, count: int = 2_000) -> Tensor:
    return problem.states.expand(1.5).sample(count, torch.Generator().manual_seed(0), torch.float64)


def sample_planes(problem: ReachAvoidProblem) -> Tensor:
    """Points of the problem's planes, where a target too thin for `sample` is found."""
    generator = torch.Generator().manual_seed(1)
    planes = [plane.embed(plane.box.sample(1_000, generator, torch.float64)) for plane in problem.planes.values()]
    return torch.cat([torch.empty(0, problem.states.dim, dtype=torch.float64), *planes])


@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_problems_do_not_contradict_themselves(problem):
    check_problem(problem)


@pytest.mark.parametrize("problem", [*PROBLEMS, Corner()], ids=name)
def test_controlled_noise_is_found(problem):
    assert has_controlled_noise(problem) == isinstance(problem, FullNoise)


@pytest.mark.parametrize("problem", [*PROBLEMS, Corner()], ids=name)
def test_sets_and_boundary_values_agree(problem):
    x = torch.cat([sample(problem), sample_planes(problem)])
    reached, failed, interior = problem.reached(x), problem.failed(x), problem.interior(x)
    assert torch.equal(interior, ~reached & ~failed)
    assert interior.any()
    assert not (reached & failed).any()
    value = problem.boundary_value(x)
    assert (value[failed] == 0).all()
    if problem.objective == "invariance":
        assert not reached.any()
        assert (value[~failed] == 1).all()
    else:
        assert reached.any()
        assert (value[reached] == 1).all()
        assert (value[interior] == 0).all()
        assert torch.equal(reached, (problem.target_constraints(x) <= 0).all(-1))
        assert torch.equal(reached, problem.target_level(x) <= 0)


@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_physics_broadcasts_and_keeps_its_dtype(problem):
    """One row at a time equals the batch, and float32 stays float32."""
    x, u = sample(problem, 6), problem.controls.sample(6, torch.Generator().manual_seed(1), torch.float64)
    for term in (problem.drift, problem.diffusion):
        whole = term(x, u)
        for index in range(6):
            torch.testing.assert_close(term(x[index], u[index]), whole[index], rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(term(x.view(2, 3, -1), u.view(2, 3, -1)).flatten(0, 1), whole)
        assert term(x.float(), u.float()).dtype == torch.float32


@pytest.mark.parametrize("problem", SHIPPED, ids=name)
def test_an_optimal_control_is_admissible(problem):
    x = sample(problem)
    u = problem.optimal_control(torch.ones(len(x), dtype=x.dtype), x)
    if u is None:
        pytest.skip("no optimal control is known")
    assert problem.controls.contains(u).all()


KNOWN = [problem for problem in SHIPPED if type(problem).exact_value is not ReachAvoidProblem.exact_value]


@pytest.mark.parametrize(
    "problem", [*KNOWN, HalfSpace(dim=8), pytest.param(RadialExit(dim=8), marks=pytest.mark.slow)], ids=name
)
def test_an_exact_value_solves_the_hjb_equation(problem):
    """Residual zero at the optimal control and not positive at any other; boundary values where they are given."""
    # Closed forms are exact to rounding; the second derivative of the series of RadialExit has an error of its own.
    tolerance = 1e-7 if isinstance(problem, RadialExit) else 1e-10
    x = sample(problem)
    x = x[problem.interior(x) & (problem.target_level(x) > 0.05)]
    tau = problem.horizon * (
        0.05 + 0.95 * torch.rand(len(x), generator=torch.Generator().manual_seed(2), dtype=x.dtype)
    )
    best = generator(problem.exact_value, problem, tau, x, problem.optimal_control(tau, x))
    assert best.abs().max() <= tolerance
    u = problem.controls.sample(len(x), torch.Generator().manual_seed(3), x.dtype)
    assert (generator(problem.exact_value, problem, tau, x, u) <= tolerance).all()
    everywhere = sample(problem)
    torch.testing.assert_close(
        problem.exact_value(torch.zeros(len(everywhere), dtype=x.dtype), everywhere), problem.boundary_value(everywhere)
    )
    absorbed = everywhere[~problem.interior(everywhere)]
    torch.testing.assert_close(
        problem.exact_value(torch.ones(len(absorbed), dtype=x.dtype), absorbed), problem.boundary_value(absorbed)
    )


def test_value_of_reach1d():
    """Against an independent table: tau in [0, 2] x x in [-2, 2], tau = 0 and the corner included."""
    tau, x = np.meshgrid(GOLDEN["tau"], GOLDEN["x"], indexing="ij")
    value = Reach1D().exact_value(torch.tensor(tau), torch.tensor(x).unsqueeze(-1))
    np.testing.assert_allclose(value.numpy(), GOLDEN["value"], rtol=0, atol=1e-12)


def test_value_of_exit1d_is_its_eigenfunction_series():
    """Against the other series of the docstring, at times at which 60 terms of it are exact to 1e-12."""
    tau, x = (grid.flatten() for grid in np.meshgrid(np.linspace(0.05, 1, 20), np.linspace(-0.99, 0.99, 41)))
    forever = (1 - np.exp(-2 * x - 2)) / (1 - np.exp(-4))
    k = np.arange(1, 61)[:, None]
    rate = k * np.pi / 2
    terms = (-1.0) ** k * rate / (1 + rate**2) * np.sin(rate * (x + 1)) * np.exp(-(1 + rate**2) * tau / 2)
    value = Exit1D().exact_value(torch.tensor(tau), torch.tensor(x).unsqueeze(-1))
    np.testing.assert_allclose(value.numpy(), forever + np.exp(1 - x) * terms.sum(0), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("states", "rollouts"), [(6, 1_000), pytest.param(12, 4_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("problem", [HalfSpace(dim=3), RadialExit(dim=3)], ids=name)
def test_values_in_several_dimensions_agree_with_monte_carlo(problem, states, rollouts):
    """Steps of 1/200 of the horizon; for a curved face the bridge has a bias, which is below 0.005 at such steps."""
    x = problem.states.sample(200, torch.Generator().manual_seed(4), torch.float64)
    x = x[problem.interior(x)][:states]
    tau = torch.full((len(x),), problem.horizon, dtype=x.dtype)
    played = monte_carlo(problem, problem.optimal_control, tau, x, rollouts=rollouts, dt=problem.horizon / 200, seed=5)
    error = (played.probability - problem.exact_value(tau, x)).abs()
    assert (error < 4 * (0.25 / rollouts) ** 0.5 + 0.005).all()


@pytest.mark.parametrize("dim", [2, 8, 32, 100])
@pytest.mark.parametrize("kind", [HalfSpace, RadialExit])
def test_values_in_many_dimensions_vary_over_the_box(kind, dim):
    """In float32, as networks have it: no NaN, and values neither all small nor all large."""
    problem = kind(dim=dim)
    x = problem.states.sample(2_000, torch.Generator().manual_seed(0))
    x = x[problem.interior(x)]
    value = problem.exact_value(torch.full((len(x),), problem.horizon), x)
    assert value.dtype == torch.float32
    assert ((value >= 0) & (value <= 1)).all()
    assert ((value > 0.1) & (value < 0.9)).double().mean() > 0.5


@pytest.mark.parametrize(("kind", "least"), [(HalfSpace, 1), (RadialExit, 2)])
def test_dimensions_that_are_refused(kind, least):
    with pytest.raises(ArgumentError, match=f"dim: expected an integer >= {least}, got 0"):
        kind(dim=0)


def test_value_of_reach1d_far_away_neither_overflows_nor_loses_its_gradient():
    tau, x = torch.tensor([1e-6, 2.0, 0.0, 2.0]), torch.tensor([[-60.0], [-60.0], [1.0], [3.0]], requires_grad=True)
    value = Reach1D().exact_value(tau, x)
    assert torch.equal(value.detach(), torch.tensor([0.0, 0.0, 0.0, 1.0]))
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert gradient.isfinite().all()


def test_default_avoid_set_is_empty():
    x = sample(Reach1D())
    assert not Reach1D().failed(x).any()
    assert not Reach1D().has_avoid_set
    assert Safety1D().has_avoid_set
    assert torch.equal(Safety1D().failed(x), x[:, 0].abs() >= 1)


def test_constructor_arguments_change_this_problem_alone():
    problem = Reach1D(payoff=LipschitzPayoff(0.3), horizon=1)
    assert (problem.payoff, problem.horizon) == (LipschitzPayoff(0.3), 1.0)
    assert (Reach1D().payoff.epsilon, Reach1D().horizon) == (0.0, 2.0)


# Problems that contradict themselves


class NoHorizon(ReachAvoidProblem):
    states, controls = Box([-2.0], [2.0]), Box([-1.0], [1.0])
    drift, diffusion, target_level = Reach1D.drift, Reach1D.diffusion, Reach1D.target_level


class NoTarget(ReachAvoidProblem):
    horizon, states, controls = 1.0, Box([-2.0], [2.0]), Box([-1.0], [1.0])
    drift, diffusion = Reach1D.drift, Reach1D.diffusion


class Backwards(Reach1D):
    horizon = -1.0


class ScalarDrift(Reach1D):
    def drift(self, x, u):
        return u[..., 0]


class FlatDiffusion(Reach1D):
    def diffusion(self, x, u):
        return torch.ones_like(x)


class WideDiffusion(Reach1D):
    def diffusion(self, x, u):
        return x.new_ones(*x.shape[:-1], 2, 3)


class ColumnTarget(Reach1D):
    def target_level(self, x):
        return 2 - x


class ColumnAvoid(Reach1D):
    def avoid_level(self, x):
        return x + 3


class FlatConstraints(Reach1D):
    def avoid_constraints(self, x):
        return x[..., 0] + 3


class NoConstraints(ReachAvoidProblem):
    horizon, states, controls = 1.0, Box([-2.0], [2.0]), Box([-1.0], [1.0])
    drift, diffusion = Reach1D.drift, Reach1D.diffusion

    def target_constraints(self, x):
        return x[..., :0]


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        (NoHorizon, "NoHorizon has no horizon"),
        (Backwards, "Backwards: horizon must be positive and finite, got -1.0"),
        (ScalarDrift, r"ScalarDrift.drift: expected shape \(16, 1\) for 16 states, got \(16,\)"),
        (FlatDiffusion, r"FlatDiffusion.diffusion: expected shape \(16, 1, w\) for 16 states, .* got \(16, 1\)"),
        (WideDiffusion, r"WideDiffusion.diffusion: expected shape \(16, 1, w\) for 16 states, .* got \(16, 2, 3\)"),
        (ColumnTarget, r"ColumnTarget.target_level: expected shape \(16,\) for 16 states, got \(16, 1\)"),
        (FlatConstraints, r"FlatConstraints.avoid_constraints: expected shape \(16, k\) .*, got \(16,\)"),
        (NoConstraints, r"NoConstraints.target_constraints: expected shape \(16, k\) .*, got \(16, 0\)"),
        (ColumnAvoid, r"ColumnAvoid.avoid_level: expected shape \(16,\) for 16 states, got \(16, 1\)"),
    ],
)
def test_a_wrong_part_is_named(problem, message):
    with pytest.raises(ProblemError, match=message):
        check_problem(problem())


def test_a_missing_target_is_named():
    with pytest.raises(ProblemError, match=r"NoTarget needs target_level\(x\)"):
        check_problem(NoTarget())


def test_a_missing_drift_is_named():
    class Incomplete(ReachAvoidProblem):
        diffusion, target_level = Reach1D.diffusion, Reach1D.target_level

    with pytest.raises(TypeError, match="drift"):
        Incomplete()


class Overlap(Reach1D):
    """A target above 2 and an avoid set about 2; the states in both are failures."""

    width = 0.5

    def avoid_constraints(self, x):
        return torch.stack([x[..., 0] + 5, (x[..., 0] - 2).abs() - self.width], -1)

    def avoid_level(self, x):
        return self.avoid_constraints(x).amin(-1)


@pytest.mark.parametrize("width", [0.5, 0.005])
def test_the_target_is_what_lies_outside_the_avoid_set(width):
    problem = Overlap()
    problem.width = width
    both = problem.overlap()
    assert ((both >= 2) & (both <= 2 + width)).all()
    assert problem.shared_constraints == [1]
    x = torch.tensor([[1.9], [2 + width / 2], [2 + 2 * width]])
    assert problem.reached(x).tolist() == [False, False, True]
    assert problem.failed(x).tolist() == [width == 0.5, True, False]
    assert problem.boundary_value(x).tolist() == [0, 0, 1]
    check_problem(problem)


class Reef(ZermeloBoat):
    """A reef that covers one side of the harbour."""

    def avoid_constraints(self, x):
        reef = (x - x.new_tensor([self.landing[0] + 0.4, self.landing[1]])).norm(dim=-1, keepdim=True) - 0.3
        return torch.cat([super().avoid_constraints(x), reef], -1)


class NamedReef(Reef):
    """The same problem, with a target that excludes the reef itself."""

    target_level = ReachAvoidProblem.target_level

    def target_constraints(self, x):
        return torch.stack([ZermeloBoat.target_level(self, x), -self.avoid_constraints(x)[..., -1]], -1)


def test_paths_take_a_shared_constraint_as_if_the_target_had_it():
    x = Reef().states.sample(100, torch.Generator().manual_seed(0))
    tau = torch.full((len(x),), Reef().horizon)

    def policy(tau, x):
        return 0.8 * torch.tanh(x.new_tensor(ZermeloBoat.landing) - x)

    success = [
        monte_carlo(problem, policy, tau, x, rollouts=20, dt=0.05, seed=1).probability
        for problem in (Reef(), NamedReef())
    ]
    assert [len(problem.shared_constraints) for problem in (Reef(), NamedReef())] == [1, 0]
    assert torch.equal(*success)
    assert 0.05 < success[0].mean() < 0.95


def test_the_constraints_of_disjoint_sets_stay_as_they_are():
    for problem in (Reach1D(), ZermeloBoat(), DubinsCar(), Pendulum()):
        x = problem.states.sample(100, torch.Generator().manual_seed(0))
        assert problem.shared_constraints == []
        if problem.objective == "reach-avoid":
            assert torch.equal(problem.reached_constraints(x), problem.target_constraints(x))


def test_a_smoothed_target_has_no_states_of_the_avoid_set():
    problem = Overlap(payoff=LipschitzPayoff(0.1))
    x = torch.linspace(1.5, 4, 501).unsqueeze(-1)
    inside = problem.reached(x)
    assert inside.any()
    assert not (inside & problem.failed(x)).any()
    assert x[inside].min() >= 2.6 - 1e-6


def test_a_system_without_noise_has_one_column_of_zeros():
    still = DoubleIntegrator(position_noise=0.0, speed_noise=0.0)
    check_problem(still)
    assert torch.equal(still.diffusion(torch.ones(3, 2), torch.zeros(3, 1)), torch.zeros(3, 2, 1))

    class NoColumn(DoubleIntegrator):
        def diffusion(self, x, u):
            return x.unsqueeze(-1)[..., :0]

    with pytest.raises(ProblemError, match=r"NoColumn\.diffusion: expected at least one column, got none"):
        check_problem(NoColumn())


def test_a_closed_form_is_that_of_the_indicator():
    problem, tau, x = Exit1D(), torch.ones(3), torch.zeros(3, 1)
    assert torch.equal(closed_form(problem, tau, x), problem.exact_value(tau, x))
    problem.payoff = LipschitzPayoff(0.2)
    assert closed_form(problem, tau, x) is None
    assert not [finding for finding in examine(problem) if finding.level == "error"]


def test_constants_may_be_numbers_lists_and_arrays():
    like = torch.zeros(2, dtype=torch.float64)
    assert constant(0.3, like).shape == ()
    for values in ([[0.0, 1.0], [-1.0, 0.0]], np.array([[0.0, 1.0], [-1.0, 0.0]])):
        assert torch.equal(constant(values, like), torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64))
    assert torch.equal(constant(np.array([1.0, 2.0]), like), torch.tensor([1.0, 2.0], dtype=torch.float64))
