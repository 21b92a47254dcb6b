"""Monte Carlo against closed forms: Brownian first passage, the heat equation, binomial tails."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pirl_rl.evaluation.monte_carlo import ENTRIES, PATHS, expected_deviation, monte_carlo, wilson_interval
from pirl_rl.payoffs import LipschitzPayoff
from pirl_rl.problems import HalfSpace, Reach1D, Safety1D

REACH, SAFETY = Reach1D(), Safety1D()
SIGMAS = 4
"""Two-sided tail 6e-5: with fixed seeds, a failure is a defect."""


def standard_error(p, trials: int):
    return (p * (1 - p) / trials) ** 0.5


def test_wilson_known_values():
    """The examples of Newcombe (Statistics in Medicine 17, 1998), method 3; and symmetry."""
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson_interval(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson_interval(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert wilson_interval(5, 10) == pytest.approx((0.236593, 0.763407), abs=1e-6)
    assert wilson_interval(0, 10) == (0.0, pytest.approx(0.277533, abs=1e-6))
    assert wilson_interval(10, 10) == (pytest.approx(0.722467, abs=1e-6), 1.0)
    low, high = wilson_interval(torch.tensor([0.0, 5.0, 10.0]), 10)
    assert low.tolist() == pytest.approx([0, 0.236593, 0.722467], abs=1e-6)
    assert high.tolist() == pytest.approx([0.277533, 0.763407, 1], abs=1e-6)


def test_wilson_coverage_is_nominal():
    """Exact coverage by binomial sums, averaged over p; the score interval dips a little below it for some p."""
    trials, coverages = 60, []
    bounds = [wilson_interval(k, trials) for k in range(trials + 1)]
    for p in np.linspace(0.05, 0.95, 91):
        mass = [math.comb(trials, k) * p**k * (1 - p) ** (trials - k) for k in range(trials + 1)]
        coverages.append(sum(m for m, (low, high) in zip(mass, bounds, strict=True) if low <= p <= high))
    assert min(coverages) > 0.91
    assert np.mean(coverages) == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("arguments", [(1, 0, 0.95), (1, 10, 1.0), (1, 10, 0.0)])
def test_wilson_refuses(arguments):
    with pytest.raises(ValueError, match="wilson_interval"):
        wilson_interval(*arguments)


@pytest.mark.parametrize("rollouts", [1, 8, 64])
def test_expected_deviation_is_that_of_binomial_means(rollouts):
    """Over 100,000 probabilities, 0 and 1 among them, the standard error of the sampled mean is at most 0.001."""
    rng = torch.Generator().manual_seed(0)
    p = torch.cat([torch.zeros(1000), torch.ones(1000), torch.rand(98_000, generator=rng)]).double()
    mean = torch.binomial(torch.full_like(p, rollouts), p, generator=rng) / rollouts
    assert expected_deviation(p, rollouts) == pytest.approx((mean - p).abs().mean().item(), abs=0.004)


def test_reach1d_agrees_with_the_exact_value():
    """With the bridge and u = 1 the simulation is exact at any dt; tau = 0.25 and 0.033 are not whole steps."""
    tau = torch.tensor([2.0, 2.0, 2.0, 2.0, 0.25, 0.033], dtype=torch.float64)
    x = torch.tensor([[-2.0], [-1.0], [0.0], [1.0], [1.5], [1.9]], dtype=torch.float64)
    estimate = monte_carlo(REACH, REACH.optimal_control, tau, x, rollouts=20_000, dt=0.1)
    exact = REACH.exact_value(tau, x)
    assert ((estimate.probability - exact).abs() < SIGMAS * standard_error(exact, 20_000)).all()


def test_intervals_cover_at_their_rate():
    """Of 300 intervals of 95% all but about 15 cover; 4 deviations of that number are 15."""
    rng = torch.Generator().manual_seed(1)
    x = REACH.states.sample(300, rng, dtype=torch.float64)
    estimate = monte_carlo(REACH, REACH.optimal_control, 1.0, x, rollouts=400, dt=0.1)
    exact = REACH.exact_value(torch.ones(300, dtype=torch.float64), x)
    misses = int(((exact < estimate.low) | (exact > estimate.high)).sum())
    assert misses <= 30


def test_smoothed_payoff_interval_covers():
    """l_eps lies between the indicators of A_eps = {x >= 2 + eps} and A, so does its mean; the interval covers it."""
    epsilon, x = 0.5, torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    tau = torch.full((2,), 2.0, dtype=torch.float64)
    estimate = monte_carlo(Reach1D(LipschitzPayoff(epsilon)), REACH.optimal_control, tau, x, rollouts=20_000, dt=0.1)
    assert (REACH.exact_value(tau, x - epsilon) < estimate.probability).all()
    assert (estimate.probability < REACH.exact_value(tau, x)).all()
    repeats = [
        monte_carlo(Reach1D(LipschitzPayoff(epsilon)), REACH.optimal_control, tau, x, rollouts=200, dt=0.1, seed=seed)
        for seed in range(20)
    ]
    covered = sum(((one.low <= estimate.probability) & (estimate.probability <= one.high)).sum() for one in repeats)
    assert covered >= 0.9 * 40


def test_survival_without_control_is_the_heat_kernel():
    """u = 0: P(|W| < 1 up to tau) from x = 0, by its Fourier series."""
    tau, rollouts = 1.0, 60_000
    terms = [
        (-1) ** k * 4 / ((2 * k + 1) * math.pi) * math.exp(-(((2 * k + 1) * math.pi) ** 2) * tau / 8) for k in range(6)
    ]
    exact = sum(terms)
    estimate = monte_carlo(SAFETY, lambda tau, x: torch.zeros_like(x), tau, torch.zeros(1, 1), rollouts, dt=0.02)
    assert estimate.probability.item() == pytest.approx(exact, abs=SIGMAS * standard_error(exact, rollouts))


def finite_difference_safety(horizon: float, cells: int = 100) -> np.ndarray:
    """V(horizon, x) on `cells + 1` points of [-1, 1]: V_tau = V_xx/2 + |V_x|, V = 0 at both ends, explicit in tau."""
    dx = 2 / cells
    steps = math.ceil(horizon / (0.4 * dx**2))
    value, h = np.ones(cells + 1), horizon / steps
    value[[0, -1]] = 0
    for _ in range(steps):
        slope = (value[2:] - value[:-2]) / (2 * dx)
        curvature = (value[2:] - 2 * value[1:-1] + value[:-2]) / dx**2
        value[1:-1] += h * (curvature / 2 + np.abs(slope))
    return value


def test_safety1d_agrees_with_finite_differences():
    """Holding -sign(x) for dt costs value, about 0.006 at dt = 0.01: the estimate lies in a band below the oracle."""
    oracle = {tau: finite_difference_safety(tau)[50] for tau in (1.0, 2.0)}
    assert oracle == pytest.approx({1.0: 0.669, 2.0: 0.406}, abs=1e-3)
    tau, rollouts = torch.tensor([1.0, 2.0]), 10_000
    estimate = monte_carlo(SAFETY, SAFETY.optimal_control, tau, torch.zeros(2, 1), rollouts, dt=0.01)
    for p, exact in zip(estimate.probability.tolist(), oracle.values(), strict=True):
        error = SIGMAS * standard_error(exact, rollouts)
        assert exact - 0.008 - error < p < exact + error


def test_known_states_are_exact():
    def refuse(tau, x):
        raise AssertionError("nothing to simulate")

    x = torch.tensor([[2.0], [2.5], [1.0], [-1.0]])
    estimate = monte_carlo(REACH, refuse, torch.tensor([1.0, 0.0, 0.0, 0.0]), x, rollouts=7)
    for entry in estimate[:3]:
        assert entry.tolist() == [1, 1, 0, 0]
    survived = monte_carlo(
        SAFETY, refuse, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([[0.0], [1.0], [-1.5]]), rollouts=7
    )
    assert survived.probability.tolist() == survived.low.tolist() == survived.high.tolist() == [1, 0, 0]

    class Walled(Reach1D):
        def unreachable(self, x):
            return x[..., 0] < 0

    assert monte_carlo(Walled(), refuse, 1.0, torch.tensor([[-1.0]]), rollouts=7).high.item() == 0


def test_steps_split_tau_evenly():
    """tau = 0.25 at dt = 0.1 takes three steps of 0.25/3; tau = 0.3 in float32 takes three, not four."""
    for tau in (0.25, 0.3):
        seen: list[float] = []

        def record(t, x, seen=seen):
            seen.append(t[0].item())
            return torch.zeros_like(x)

        monte_carlo(SAFETY, record, tau, torch.zeros(1, 1), rollouts=200, dt=0.1)
        assert seen == pytest.approx([tau, 2 * tau / 3, tau / 3], rel=1e-6)


@pytest.mark.parametrize("compiled_from", [0, math.inf], ids=["compiled", "eager"])
def test_every_path_is_played_where_they_do_not_all_fit_at_once(compiled_from, monkeypatch):
    """States share the paths under way, and paths start where others end: every state gets its own rollouts."""
    monkeypatch.setattr("pirl_rl.evaluation.monte_carlo.COMPILED_FROM", compiled_from)
    x = torch.linspace(-2, 1.9, 40).unsqueeze(-1)
    rollouts = PATHS // 7
    estimate = monte_carlo(REACH, REACH.optimal_control, 2.0, x, rollouts, dt=0.5)
    exact = REACH.exact_value(torch.full((40,), 2.0), x)
    assert ((estimate.probability - exact).abs() < SIGMAS * standard_error(exact, rollouts) + 1e-6).all()


def test_with_many_states_fewer_paths_are_simulated_at_once():
    """Sigma of the half-space in 100 dimensions has 10^4 entries for each path; 1,677 paths have 2^24 of them."""
    problem, sizes = HalfSpace(dim=100), []

    def policy(tau, x):
        sizes.append(len(x))
        return problem.controls.denormalize(torch.zeros_like(x))

    estimate = monte_carlo(problem, policy, 1.0, torch.zeros(2, 100), rollouts=1_000, dt=0.5)
    assert max(sizes) == ENTRIES // 100**2 == 1_677
    assert len(estimate.probability) == 2


def test_same_kind_out_and_repeatable():
    x = np.array([[0.0], [1.0]])
    before = torch.get_rng_state()
    first, again, other = (monte_carlo(REACH, REACH.optimal_control, 1.0, x, 500, dt=0.1, seed=s) for s in (3, 3, 4))
    assert torch.equal(torch.get_rng_state(), before)
    assert isinstance(first.probability, np.ndarray)
    assert (first.probability == again.probability).all()
    assert (first.probability != other.probability).any()
    tensors = monte_carlo(REACH, REACH.optimal_control, torch.ones(2), torch.tensor(x), 500, dt=0.1, seed=3)
    assert isinstance(tensors.low, torch.Tensor)
    assert tensors.low.dtype == torch.float64
    assert tensors.rollouts == 500


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"x": torch.zeros(3)}, "x: expected states of shape"),
        ({"x": torch.zeros(3, 2)}, "x: expected states of shape"),
        ({"tau": -1.0}, "tau"),
        ({"tau": torch.ones(4)}, "tau"),
        ({"rollouts": 0}, "rollouts"),
        ({"dt": 3.0}, "dt"),
        ({"crossing": "guess"}, "crossing"),
    ],
)
def test_wrong_arguments_are_named(change, named):
    arguments = {"tau": 1.0, "x": torch.zeros(3, 1)} | change
    with pytest.raises(ValueError, match=named):
        monte_carlo(REACH, REACH.optimal_control, **arguments)


def test_without_time_steps_those_of_a_training_are_taken():
    """A horizon of milliseconds needs no step from the caller; V within four standard errors of 4,000 paths."""
    problem = Reach1D(horizon=5e-3)
    x = torch.tensor([[1.95], [1.99]])
    estimate = monte_carlo(problem, problem.optimal_control, 5e-3, x, rollouts=4_000)
    exact = problem.exact_value(torch.full((2,), 5e-3), x)
    assert (estimate.probability - exact).abs().max() < 4 * 0.5 / 4_000**0.5
