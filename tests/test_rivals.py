"""The rivals of the suite: the regulator against the Riccati equation, and learners that learn an easy problem."""

from __future__ import annotations

import math

import pytest
import torch

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.problems import CartPole, DoubleIntegrator, DubinsCar, PlanarQuadrotor, Reach1D
from pirl_rl.rivals import RIVALS, find_rival
from pirl_rl.rivals.linear_quadratic import linear_quadratic
from pirl_rl.simulator import Simulator


def test_the_gain_of_the_double_integrator_solves_the_riccati_equation():
    """For p'' = u with costs (p/a)^2 + (v/a)^2 + u^2 the gain is (1/a, sqrt(1/a^2 + 2/a)), by hand; a is the tolerance.

    The widths of the target come from sampled points of its faces, hence 1 %.
    """
    problem = DoubleIntegrator()
    policy = linear_quadratic(problem, Simulator(problem, 0.1), 0.0, 0)
    gain = -policy(torch.ones(2), 1e-3 * torch.eye(2)).squeeze(-1) / 1e-3
    a = problem.tolerance
    assert gain.tolist() == pytest.approx([1 / a, math.sqrt(1 / a**2 + 2 / a)], rel=0.01)
    assert policy(torch.ones(1), torch.tensor([[100.0, 0.0]])).item() == problem.controls.low[0]


@pytest.mark.parametrize(("problem", "steps"), [(CartPole(), 500), (PlanarQuadrotor(), 500)])
def test_the_regulator_holds_systems_that_fall_by_themselves(problem, steps):
    """Near rest without noise it stays; a constant control leaves the safe set."""
    policy = linear_quadratic(problem, Simulator(problem, 0.1), 0.0, 0)
    x = torch.zeros(1, problem.states.dim)
    x[:, 2] = 0.05
    if isinstance(problem, PlanarQuadrotor):
        x[:, 1] = 1.0
    for _ in range(steps):
        x = x + 0.005 * problem.drift(x, policy(torch.ones(1), x))
    assert x[0, 2].abs() < 0.01


def test_a_car_that_cannot_stop_has_no_regulator():
    with pytest.raises(ArgumentError, match="lqr: expected a state at rest in the target, found none"):
        linear_quadratic(DubinsCar(), Simulator(DubinsCar(), 0.1), 0.0, 0)


def after_steps(name, calls, problem, simulator, monkeypatch):
    """The policy of a learner of the library after a number of steps of all paths, which takes the place of the time
    that ends a training: that differs between machines."""
    pytest.importorskip("stable_baselines3")
    from pirl_rl.rivals import stable_baselines

    monkeypatch.setattr(stable_baselines.Stopwatch, "_on_step", lambda callback: callback.n_calls < calls)
    return find_rival(name)(problem, simulator, math.inf, 0)


TAU, X = torch.full((50,), 2.0), torch.linspace(-0.8, 0.8, 50).unsqueeze(-1)


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_learners_of_the_library_choose_controls_within_their_bounds(name, monkeypatch):
    problem = Reach1D()
    control = after_steps(name, 20, problem, Simulator(problem, 0.2), monkeypatch)(TAU, X)
    assert control.shape == (50, 1)
    assert problem.controls.contains(control).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "calls"), [("ppo", 2_560), ("sac", 400)])
def test_learners_of_the_library_learn_to_reach(name, calls, monkeypatch):
    """Their policy comes nearer to the optimum of the one-dimensional benchmark than to its reverse."""
    problem = Reach1D()
    simulator = Simulator(problem, 0.2)
    learned = after_steps(name, calls, problem, simulator, monkeypatch)

    def success(policy):
        return mean_payoff(simulator, policy, TAU, X, 40, torch.Generator().manual_seed(0)).mean()

    best, worst = success(problem.optimal_control), success(lambda tau, x: -problem.optimal_control(tau, x))
    assert success(learned) > (best + worst) / 2


def test_names_of_rivals():
    assert {*RIVALS} == {"lqr", "ppo", "sac"}
    with pytest.raises(ArgumentError, match="rivals: expected names out of lqr, ppo, sac, got 'mpc'"):
        find_rival("mpc")


def test_missing_packages_are_named(monkeypatch):
    def absent(name):
        raise ModuleNotFoundError(name="stable_baselines3")

    monkeypatch.setattr("pirl_rl.rivals.import_module", absent)
    with pytest.raises(ArgumentError, match=r"ppo needs stable_baselines3: pip install 'pirl_rl\[baselines\]'"):
        find_rival("ppo")
