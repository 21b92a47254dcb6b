"""Evaluators on solutions whose metrics are known: the exact value, a reversed policy, and networks to repeat."""

from __future__ import annotations

import math

import pytest
import torch
from small import metrics as measure
from torch import Tensor

from pirl_rl import problems
from pirl_rl.evaluation import (
    Accuracy,
    Calibration,
    ExactError,
    Residuals,
    Rollouts,
    Slices,
    Success,
    evaluate,
    meanings_of,
    metrics_of,
)
from pirl_rl.evaluation.reference_states import ReferenceStates
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.operators import generator
from pirl_rl.payoffs import LipschitzPayoff
from pirl_rl.problems import Reach1D, Safety1D
from pirl_rl.sampling.initial_states import UniformStates
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

EVALUATORS = {
    "exact": ExactError(),
    "calibration": Calibration(32, 32),
    "success": Success(500),
    "residuals": Residuals(256),
}


def normal_cdf(z: Tensor) -> Tensor:
    return torch.special.erfc(-z / math.sqrt(2)) / 2


def first_passage(tau: Tensor, x: Tensor, u: float) -> Tensor:
    """P(reach 2 within tau) under the constant control u, the reflection formula, with the boundary's own values."""
    d = 2 - x[..., 0]
    inside = (d > 0) & (tau > 0)
    d, t = torch.where(inside, d, 1.0), torch.where(inside, tau, 1.0)
    value = normal_cdf((u * t - d) / t.sqrt()) + torch.exp(2 * u * d) * normal_cdf((-u * t - d) / t.sqrt())
    return torch.where(inside, value, (2 - x[..., 0] <= 0).to(value))


class Known:
    """Stands for a `Solution`: the control is `u` everywhere and V is the value of `u`, plus an error if wanted."""

    dtype, device = torch.float64, torch.device("cpu")

    def __init__(self, u: float = 1.0, offset: float = 0.0):
        self.problem, self.u, self.offset = Reach1D(), u, offset

    def policy(self, tau, x):
        return torch.full_like(x, self.u)

    def raw_value(self, tau, x):
        return first_passage(tau, x, self.u) + self.offset

    def value(self, tau, x):
        return torch.where(self.problem.reached(x), torch.ones_like(tau), self.raw_value(tau, x))

    def residual(self, tau, x, u=None):
        return generator(self.raw_value, self.problem, tau, x, self.policy(tau, x) if u is None else u)

    def gradient(self, tau, x):
        return torch.func.jvp(lambda y: self.raw_value(tau, y), (x,), (torch.ones_like(x),))[1].unsqueeze(-1)


@pytest.fixture(params=[Reach1D, Safety1D])
def network(request):
    torch.manual_seed(0)
    problem = request.param()
    return Solution(problem, Actor(problem), stack([Critic(problem, action_input=True) for _ in range(2)]))


def test_exact_error_of_the_exact_value_is_zero():
    metrics = measure(ExactError(), Known())
    assert max(metrics.values()) < 1e-10
    assert set(metrics) == {"value_mse", "value_max_error", "masked_value_mse"}


def test_exact_error_of_a_known_offset():
    """An offset of 0.1 is in every raw value; the mask takes it off on the 1 of 201 columns that lies in the target."""
    metrics = measure(ExactError(), Known(offset=0.1))
    assert metrics["value_mse"] == pytest.approx(0.01)
    assert metrics["value_max_error"] == pytest.approx(0.1)
    assert metrics["masked_value_mse"] == pytest.approx(0.01 * 200 / 201)


def test_exact_error_needs_an_exact_value(network):
    known = network.problem.exact_value(torch.ones(1), torch.zeros(1, 1)) is not None
    assert bool(measure(ExactError(11, 11), network)) == known


def test_exact_error_in_two_dimensions_samples_the_box():
    class Plane(Reach1D):
        states = type(Reach1D.states)([-2.0, 0.0], [2.0, 1.0])

    known = Known(offset=0.1)
    known.problem = Plane()
    assert measure(ExactError(20, 20), known)["value_mse"] == pytest.approx(0.01)


def test_residuals_of_the_exact_value_vanish():
    metrics = measure(Residuals(1024), Known())
    assert metrics["hjb_loss"] < 1e-16
    assert metrics["hjb_sup_loss"] < 1e-16
    assert metrics["boundary_loss"] < 1e-8


def test_sup_residual_exposes_a_reversed_policy():
    """The value of u = -1 solves its own linear equation and the boundary; max_u L^u V = 2 V_x betrays it."""
    reversed_policy = Known(u=-1.0)
    metrics = measure(Residuals(1024), reversed_policy)
    assert metrics["hjb_loss"] < 1e-16
    assert metrics["boundary_loss"] < 1e-8
    uniform = torch.Generator().manual_seed(5)
    tau, x = (
        2 * torch.rand(200_000, generator=uniform).double(),
        4 * torch.rand(200_000, 1, generator=uniform).double() - 2,
    )
    slope = torch.func.jvp(lambda x: reversed_policy.raw_value(tau, x), (x,), (torch.ones_like(x),))[1]
    assert metrics["hjb_sup_loss"] == pytest.approx((2 * slope).square().mean().item(), rel=0.2)
    # The box has a half width of 2.
    assert metrics["value_slope"] == pytest.approx(2 * slope.abs().mean().item(), rel=0.02)


def test_residuals_on_reference_states_are_those_of_the_states():
    tau, x = torch.tensor([0.5, 1.0, 1.5, 0.0]), torch.tensor([[1.0], [0.0], [-1.0], [0.0]])
    states = ReferenceStates(tau, x, torch.zeros(4), torch.arange(4))
    reversed_policy = Known(u=-1.0)
    metrics = measure(Residuals(64, states=lambda: states), reversed_policy)
    # The last state has no time to go, and no equation.
    slope = reversed_policy.gradient(tau[:3].double(), x[:3].double())
    assert metrics["hjb_sup_loss"] == pytest.approx((2 * slope).square().mean().item(), rel=1e-6)
    assert metrics["value_slope"] == pytest.approx(2 * slope.abs().mean().item(), rel=1e-6)


def test_gradient_is_that_of_the_raw_value(network):
    tau, x = torch.rand(50), network.problem.states.sample(50, torch.Generator().manual_seed(0))
    action = network._action(tau, x)
    value = network.critic.at(action.detach())

    def one(t, y):
        frozen = network._action(t.reshape(1), y.reshape(1, 1)).detach()
        return value.critic(t.reshape(1, 1), y.reshape(1, 1), frozen)

    exact = [torch.func.jacfwd(lambda y, t=t: one(t, y).mean())(y) for t, y in zip(tau, x, strict=True)]
    torch.testing.assert_close(network.gradient(tau, x), torch.stack(exact).reshape(50, 1), atol=1e-5, rtol=1e-4)


def test_boundary_loss_of_a_known_offset():
    assert measure(Residuals(512), Known(offset=0.1))["boundary_loss"] == pytest.approx(0.01, rel=1e-3)


def one_step_variance(dt: float, points: int = 200, nodes: int = 161) -> float:
    """E (V(y) - V(y'))^2 for the exact value and u = 1, by quadrature over y, the end point and the crossing."""
    steps = torch.arange(1, round(2 / dt) + 1, dtype=torch.float64)[:, None, None]
    x = (4 * (torch.arange(points, dtype=torch.float64) + 0.5) / points - 2)[:, None, None]
    z = torch.linspace(-6, 6, nodes, dtype=torch.float64)
    weight = torch.exp(-z * z / 2) / torch.exp(-z * z / 2).sum()
    end = x[..., 0] + dt + math.sqrt(dt) * z
    hit = torch.exp(-2 * (2 - x[..., 0]) * (2 - end).clamp(min=0) / dt)
    value = first_passage(steps * dt, x[None], 1.0)
    later = first_passage((steps - 1) * dt, end[None, ..., None], 1.0)
    return ((hit * (1 - value) ** 2 + (1 - hit) * (later - value) ** 2) * weight).sum(-1).mean().item()


@pytest.mark.parametrize("dt", [0.1, 0.02])
def test_td_loss_of_the_exact_value_is_the_variance_of_a_step(dt):
    """16,384 transitions estimate it with a deviation of 2% (dt = 0.1) and 4% (dt = 0.02)."""
    assert measure(Residuals(16_384), Known(), dt=dt)["td_loss"] == pytest.approx(one_step_variance(dt), rel=0.12)


def test_td_loss_sees_a_wrong_value():
    """An offset c of V stays in the error of the steps that end an episode, and only there."""
    exact, wrong = (measure(Residuals(16_384), Known(offset=offset))["td_loss"] for offset in (0.0, 0.3))
    assert exact + 0.3**2 * 0.05 < wrong < exact + 0.3**2 * 0.5


def test_calibration_of_the_exact_value_is_its_noise():
    metrics = measure(Calibration(256, 256), Known())
    assert metrics["calibration_mse"] == pytest.approx(metrics["calibration_noise"], rel=0.4)
    worse = measure(Calibration(256, 256), Known(offset=0.1))
    assert worse["calibration_mse"] == pytest.approx(0.01 + metrics["calibration_noise"], rel=0.2)
    assert worse["calibration_mae"] == pytest.approx(0.1, rel=0.1)


def test_success_rate_of_constant_controls():
    """From x = 0 with the whole horizon to go: the exact hit probabilities, within 4 standard errors of 20,000."""
    start = UniformStates([-1e-6], [1e-6], tau="fixed")
    evaluator = Success(20_000, initial_states=start)
    for u in (1.0, -1.0):
        exact = first_passage(torch.tensor([2.0]), torch.zeros(1, 1), u).item()
        metrics = measure(evaluator, Known(u))
        assert metrics["success_rate"] == pytest.approx(exact, abs=4 * math.sqrt(exact * (1 - exact) / 20_000))
        assert metrics["success_low"] < metrics["success_rate"] < metrics["success_high"]
        assert metrics["reward"] == metrics["success_rate"]
        assert metrics["optimal_reward"] == pytest.approx(0.6277, abs=0.014)


def test_success_watched_at_end_points_only():
    """Twenty steps of 0.1 s watched at their ends hit with probability 0.5772, a known number."""
    start = UniformStates([-1e-6], [1e-6], tau="fixed")
    metrics = measure(Success(20_000, initial_states=start), Known(), crossing="endpoint")
    assert metrics["success_rate"] == pytest.approx(0.5772, abs=0.014)


def test_success_of_a_smoothed_payoff_counts_the_hard_target():
    smooth = Known()
    smooth.problem = Reach1D(LipschitzPayoff(0.5))
    hard, soft = (
        measure(Success(5_000, initial_states=UniformStates([-2.0], [1.8])), Known()),
        measure(Success(5_000, initial_states=UniformStates([-2.0], [1.8])), smooth),
    )
    assert soft["success_rate"] == hard["success_rate"]
    assert soft["reward"] < hard["reward"]


def test_evaluation_repeats_and_leaves_torch_alone(network):
    before = torch.get_rng_state()
    simulator = Simulator(network.problem)
    first, again = (metrics_of(evaluate(network, simulator, EVALUATORS)) for _ in range(2))
    assert torch.equal(torch.get_rng_state(), before)
    assert first == again
    assert all(type(value) is float and math.isfinite(value) for value in first.values())


def reference_states(problem) -> ReferenceStates:
    """Around uniform states of the box."""
    rng = torch.Generator().manual_seed(2)
    tau, x = problem.horizon * torch.rand(50, generator=rng), problem.states.sample(50, rng)
    box = Box([0.0, *problem.states.low], [problem.horizon, *problem.states.high])
    return ReferenceStates.from_visited(problem, tau, x, box, rng, count=50)


@pytest.mark.parametrize("name", problems.__all__)
def test_every_metric_has_a_meaning_of_its_own_for_every_problem(name):
    """The texts are whole sentences, hold the evaluators' own sizes, and know nothing of any one problem."""
    torch.manual_seed(0)
    problem = getattr(problems, name)()
    solution = Solution(problem, Actor(problem), stack([Critic(problem)]))
    evaluators = {
        "exact": ExactError(7, 9),
        "calibration": Calibration(12, 3),
        "success": Success(41),
        "residuals": Residuals(34),
        "on_states": Residuals(34, lambda: reference_states(problem)),
        "accuracy": Accuracy(lambda: reference_states(problem), 5),
        "slices": Slices(6, 2),
        "rollouts": Rollouts(2, 6),
    }
    evidence, sizes = evaluate(solution, Simulator(problem, problem.horizon / 4), evaluators), set()
    for name, evaluator in evaluators.items():
        meanings = evaluator.meanings(problem)
        assert list(evidence[name].metrics()) == list(meanings)
        sizes |= {word for text in meanings.values() for word in text.replace(",", " ").split() if word.isdigit()}
    assert {"12", "3", "41", "34", "5"} <= sizes
    meanings = {metric: text for group in meanings_of(evaluators, problem).values() for metric, text in group.items()}
    assert set(metrics_of(evidence)) == set(meanings)
    for text in meanings.values():
        assert text[0].isupper()
        assert text.endswith(".")
        assert not {"drift", "friction", "car", "vehicle"} & set(text.lower().replace(".", " ").split())


def test_meanings_follow_the_problem_and_the_arguments():
    assert "101 x 201 grid" in ExactError().meanings(Reach1D())["value_mse"]
    assert ExactError().meanings(Safety1D()) == {}
    assert "reach A before B" in Success().meanings(Reach1D())["success_rate"]
    assert "stay out of B" in Success().meanings(Safety1D())["success_rate"]
    assert "optimal_reward" not in Success().meanings(problems.VehicleDrift())
    simulators = {"coarse": {"dt": 0.2, "substeps": 2, "crossing": "bridge"}}
    meanings = Accuracy(lambda: reference_states(Reach1D()), 17, simulators).meanings(Reach1D())
    assert all(name.startswith("coarse_") for name in meanings)
    assert "17 rollouts" in meanings["coarse_mse"]
    assert "control steps of 0.2 s, integration steps of 0.1 s and the exit rule bridge" in meanings["coarse_mse"]


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        (ExactError, {"tau_points": 1}),
        (Calibration, {"rollouts": 1}),
        (Success, {"episodes": 0}),
        (Residuals, {"points": 0}),
    ],
)
def test_wrong_sizes_are_refused(kind, arguments):
    with pytest.raises(ValueError, match=f"{kind.__name__}.*{next(iter(arguments))}"):
        kind(**arguments)


class InSinglePrecision(Known):
    dtype = torch.float32


def test_starts_and_noise_are_independent():
    """Success of the optimal control over 10^4 bridge episodes is the mean of the exact V over the law of the starts,
    within four standard errors; starts and noise from one stream were six off."""
    problem, count = Reach1D(), 10_000
    x = torch.linspace(-2, 2, 4_001, dtype=torch.float64)[:-1, None] + 5e-4
    taus = [torch.full((len(x),), 0.1 * k, dtype=torch.float64) for k in range(1, 21)]
    exact = torch.stack([problem.exact_value(tau, x).mean() for tau in taus]).mean().item()
    rate = measure(Success(episodes=count), InSinglePrecision())["success_rate"]
    assert rate == pytest.approx(exact, abs=4 * (exact * (1 - exact) / count) ** 0.5)
