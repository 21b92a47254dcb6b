"""Corollary 1 as numbers: known residuals, known Lipschitz constants, and no way to take it for a bound."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from oracles import nested_generator, points, random_solution
from scipy.stats import qmc

from pirl_rl import certify as certify_command
from pirl_rl import load_run
from pirl_rl.certificates import LawOfStarts, SuccessBound, certify, diagnose
from pirl_rl.certificates.corollary import right_hand_side
from pirl_rl.certificates.field import Field, field_of, unmet_assumptions
from pirl_rl.certificates.lipschitz import STEP, largest_from_mean, lipschitz_constant, neighbours
from pirl_rl.certificates.residuals import measure
from pirl_rl.errors import ArgumentError
from pirl_rl.grid import GridSolver
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.operators import generator
from pirl_rl.payoffs import SmoothPayoff
from pirl_rl.problems import DoubleIntegrator, Exit1D, HalfSpace, RadialExit, Reach1D, Safety1D
from pirl_rl.sampling.initial_states import UniformStates
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


@pytest.mark.parametrize("dim", [1, 2, 4])
@pytest.mark.parametrize("height", [0.3, 1.7, 2.6, 40.0])
def test_a_cone_in_a_corner_has_the_largest_value_for_its_mean(dim, height):
    """By quadrature of max(M - L |z - corner|, 0): the share (r/2)^d of the cube is within r of its corner."""
    slope, distance = 1.3, 2 * ((np.arange(100_000) + 0.5) / 100_000) ** (1 / dim)
    mean = np.maximum(height - slope * distance, 0).mean()
    assert largest_from_mean(mean, slope, dim) == pytest.approx(height, rel=2e-3)


def test_no_function_exceeds_what_its_mean_and_its_slope_allow():
    rng = np.random.default_rng(0)
    cube = 2 * qmc.Sobol(2, seed=0).random_base2(14) - 1
    for _ in range(50):
        wave, shift = rng.normal(size=2) * rng.uniform(0, 4), rng.uniform(0, 6)
        g = np.abs(np.sin(cube @ wave + shift))
        assert g.max() <= largest_from_mean(g.mean(), np.abs(wave).sum(), 2) * (1 + 1e-3)
    assert largest_from_mean(0.2, 0.0, 3) == 0.2


@pytest.mark.parametrize("dim", [4, 9])
def test_the_end_of_the_slopes_is_found(dim):
    """Slopes 1 - |z|^2/d have the end 1, which the sample does not reach. The level of the upper end is approximate."""
    rng = np.random.default_rng(dim)
    found = [lipschitz_constant(1 - np.square(rng.uniform(-1, 1, (16_384, dim))).mean(1), 0.95) for _ in range(20)]
    assert np.median([one.estimate for one in found]) == pytest.approx(1, abs=0.01)
    assert sum(one.upper is None or one.upper >= 1 for one in found) >= 17
    assert np.median([one.upper for one in found]) < 1.1
    assert all(one.largest <= one.estimate <= one.upper for one in found)


def test_slopes_without_an_end_have_no_estimate():
    slopes = np.random.default_rng(0).pareto(2, 16_384)
    found = lipschitz_constant(slopes, 0.95)
    assert found == (slopes.max(), None, None)
    assert found.stated == slopes.max()
    assert lipschitz_constant(np.full(300, 2.0), 0.95) == (2.0, 2.0, 2.0)


def test_neighbours_stay_in_the_cube_and_find_the_slope_of_a_plane():
    rng = torch.Generator().manual_seed(0)
    z = 2 * torch.rand(4_000, 3, generator=rng, dtype=torch.float64) - 1
    z[:100] = z[:100].sign()
    gradient, moves = torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64), torch.tensor([True, True, False])
    other = neighbours(z, moves, rng)
    assert other.abs().max() <= 1
    assert torch.equal(other[:, 2], z[:, 2])
    assert torch.allclose((other - z)[:, :2].abs(), torch.tensor(STEP).double())
    slopes = (other - z) @ gradient / STEP
    assert slopes.abs().max().item() == pytest.approx(5)
    assert slopes.abs().min().item() == pytest.approx(1)


def raised(problem, rate) -> Field:
    """The exact value plus rate * tau, whose residual is -rate; it misses the data on the faces by rate * tau."""

    def value(tau, x):
        return problem.exact_value(tau, x) + rate * tau

    def residual(tau, x):
        return generator(value, problem, tau, x, problem.optimal_control(tau, x))

    return Field(problem, value, residual)


@pytest.mark.parametrize("problem", [Reach1D(), HalfSpace(dim=3)], ids=["reach1d", "halfspace"])
def test_a_known_residual_is_measured(problem):
    rate, horizon = 0.03, problem.horizon
    field = raised(problem, rate)
    inside, parts = measure(field, 4_096, 0.95, torch.Generator().manual_seed(0))
    for number in (parts["inside"].mean, parts["inside"].almost, parts["inside"].largest, parts["inside"].everywhere):
        assert number == pytest.approx(rate, abs=1e-6)
    assert parts["start"].largest < 1e-12
    assert parts["faces"].mean == pytest.approx(rate * horizon / 2, rel=0.05)
    assert parts["faces"].almost <= parts["faces"].largest <= rate * horizon
    # tau is half the horizon times a coordinate.
    assert parts["faces"].lipschitz.largest >= rate * horizon / 2 * (1 - 1e-6)
    error = (field.value(inside.tau, inside.x) - problem.exact_value(inside.tau, inside.x)).max().item()
    side = right_hand_side(parts, horizon)
    assert error <= side["right_hand_side_sampled"] <= 2 * rate * horizon * (1 + 1e-4)
    assert side["right_hand_side"] >= side["right_hand_side_sampled"]


@pytest.mark.parametrize("action_input", [False, True])
def test_the_field_of_networks_is_their_value_and_its_full_residual(action_input):
    """Critics Q(tau, x, u) are differentiated through the policy too, unlike in `Solution.residual`."""
    problem = HalfSpace(dim=3)
    torch.manual_seed(0)
    critics = [Critic(problem, (16, 16), action_input=action_input) for _ in range(2)]
    solution = Solution(problem, Actor(problem, (16,), "Tanh"), stack(critics))
    tau, x, _, _ = points(problem, 40)
    tau, x = tau.double(), x.double()
    field = field_of(solution)
    u = solution.policy(tau, x).double()
    assert torch.allclose(field.value(tau, x), solution.raw_value(tau, x).double(), atol=1e-6)
    assert torch.allclose(field.residual(tau, x), nested_generator(field.value, problem, tau, x, u), atol=1e-5)
    same = torch.allclose(field.residual(tau, x), solution.residual(tau, x).double(), atol=1e-4)
    assert same == (not action_input)


def test_assumptions_that_do_not_hold_are_named():
    rng = torch.Generator()

    def unmet(problem, actor="Tanh", action_input=False):
        critic = stack([Critic(problem, (4,), action_input=action_input)])
        return " ".join(unmet_assumptions(Solution(problem, Actor(problem, (4,), actor), critic), rng))

    smooth = SmoothPayoff(0.1)
    assert unmet(DoubleIntegrator(smooth)) == ""
    assert unmet(Exit1D()) == "continuous data, which jump where a face meets tau = 0"
    assert "continuous data" in unmet(Safety1D())
    assert "paths may leave the box" in unmet(Reach1D(smooth))
    assert unmet(DoubleIntegrator(smooth, position_noise=0.0)) == "noise in every direction"
    assert unmet(DoubleIntegrator(smooth), "ReLU", action_input=True).startswith("a smooth V, while the activations")
    assert unmet(DoubleIntegrator(smooth), "ReLU") == ""


@pytest.mark.parametrize("problem", [Safety1D(), Exit1D(SmoothPayoff(0.2)), RadialExit(dim=3), DoubleIntegrator()])
def test_any_problem_has_the_numbers(problem):
    """Invariance, smoothed payoffs and states of several dimensions; the error is that of a V that is known."""
    solution = random_solution(problem)
    found = diagnose(solution, Simulator(problem, problem.horizon / 4), 0.95, 3)
    numbers = found.numbers
    assert found.kind == "diagnostic"
    json.dumps(found.to_dict(), allow_nan=False)
    assert (
        numbers["right_hand_side"] >= numbers["right_hand_side_sampled"] >= problem.horizon * numbers["inside_largest"]
    )
    assert 0 < numbers["inside_mean"] < numbers["inside_almost"] <= numbers["inside_largest"]
    assert 0 < numbers["error_mean"] < numbers["error_largest"]
    # The exact value is that of the indicator.
    exact = problem.exact_value(torch.ones(1), torch.zeros(1, problem.states.dim)) is not None
    assert ("error_above" in numbers) == (exact and problem.payoff.epsilon == 0)
    assert "This bounds nothing" in found.sentences[0]


def test_the_certificate_keeps_claims_and_diagnostics_apart(trained, in_process):
    """The claims are the same with and without, and nobody who reads the file can take one for the other."""
    arguments = (f"run={trained}", "claims=[success]", "episodes=100", "dt=0.5")
    code, text = in_process(certify_command)(*arguments, "corollary=true")
    assert code == 0, text
    written = json.loads((trained / "certificate.json").read_text())
    plain = load_run(trained).certify(claims=["success"], episodes=100, dt=0.5)
    assert written["claims"] == plain.to_dict()["claims"]
    assert [*written["claims"]] == ["success"]
    assert plain.to_dict()["diagnostics"] == {}
    assert written["diagnostics"]["corollary"]["kind"] == "diagnostic"
    assert not {"confidence", "lower", "upper", "holds", "bounded"} & {*written["diagnostics"]["corollary"]}
    assert "corollary, a diagnostic\n          This bounds nothing." in text
    assert load_run(trained).certify(claims=["success"], episodes=100, dt=0.5, corollary=True).to_dict() == written


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"corollary": 1}, "corollary: expected true or false, got 1"),
        ({"confidence": 0.4}, "confidence: expected a number above 0.5 with corollary=true, got 0.4"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    problem = Exit1D()
    arguments = {"starts": LawOfStarts(UniformStates()), "certifiers": {"success": SuccessBound(10)}, "corollary": True}
    with pytest.raises(ArgumentError, match=message):
        certify(random_solution(problem), Simulator(problem, dt=0.5), **arguments | change)


def test_a_solution_without_networks_is_refused():
    with pytest.raises(ArgumentError, match="corollary: expected the networks of a run, got a GridSolution"):
        field_of(GridSolver(Exit1D(), 21).solve())
