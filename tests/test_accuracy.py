"""Accuracy on reference states: numbers by hand, and a solution whose value and policy are known."""

from __future__ import annotations

import pytest
import torch
from matplotlib.figure import Figure
from small import metrics as measure

from pirl_rl.evaluation import Accuracy, Calibration, Metrics
from pirl_rl.evaluation.accuracy import AccuracyEvidence
from pirl_rl.evaluation.reference_states import ReferenceStates
from pirl_rl.evaluation.rollout_comparison import RolloutComparison
from pirl_rl.figures import draw, draw_all
from pirl_rl.problems import Reach1D, VehicleDrift
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator

BRIDGE = {"exact": {"dt": 0.1, "substeps": 1, "crossing": "bridge"}}


class Known:
    """Stands for a `Solution` of reach1d: the optimal control, the exact value plus an offset; states below -1 are
    taken as known to be lost."""

    dtype, device = torch.float64, torch.device("cpu")

    class problem_type(Reach1D):
        def unreachable(self, x):
            return x[..., 0] < -1

    def __init__(self, offset: float = 0.0):
        self.problem, self.offset = self.problem_type(), offset

    def policy(self, tau, x):
        return torch.ones_like(x)

    def raw_value(self, tau, x):
        return self.problem.exact_value(tau, x) + self.offset

    def value(self, tau, x):
        return self.raw_value(tau, x).masked_fill(self.problem.unreachable(x), 0.0)


def states(count: int = 400) -> ReferenceStates:
    rng = torch.Generator().manual_seed(2)
    tau, x = 2 * torch.rand(count, generator=rng), 4 * torch.rand(count, 1, generator=rng) - 2
    return ReferenceStates.from_visited(Reach1D(), tau, x, Box([0.0, -2.0], [2.0, 2.0]), rng, count)


def by_hand() -> AccuracyEvidence:
    """Six states in five groups, two of them with V known to be 0."""
    group = torch.tensor([0, 0, 1, 2, 3, 4])
    value = torch.tensor([0.95, 0.60, 0.40, 0.05, 0.0, 0.0], dtype=torch.float64)
    mean = torch.tensor([0.85, 0.40, 0.60, 0.05, 0.0, 0.0], dtype=torch.float64)
    raw = torch.tensor([0.95, 0.60, 0.40, 0.05, 0.3, 0.2], dtype=torch.float64)
    reachable = torch.tensor([True, True, True, True, False, False])
    reference = ReferenceStates(torch.ones(6), torch.zeros(6, 1), torch.arange(6.0), group)
    comparison = RolloutComparison(reference.tau, reference.x, value, raw, mean, rollouts=11)
    return AccuracyEvidence(reference, reachable, {"some": comparison})


def test_numbers_by_hand():
    expected = {
        "mse": (0.01 + 0.04 + 0.04) / 6,
        "mae": (0.1 + 0.2 + 0.2) / 6,
        "noise": (0.85 * 0.15 + 0.4 * 0.6 + 0.6 * 0.4 + 0.05 * 0.95) / 6 / 10,
        "raw_mse": (0.01 + 0.04 + 0.04 + 0.09 + 0.04) / 6,
        "mse_band": (0.01 + 0.04 + 0.04) / 4,
        "mse_closest": 0.025,
        "mse_near": 0.04,
        "mse_moderate": 0.0,
        "mse_far": 0.0,
        "mse_farthest": 0.0,
        "success": 1.9 / 6,
        "success_band": 1.9 / 4,
        # {V > 0.1} is the first three states, as is {MC > 0.1}.
        "precision_p10": 1.0,
        "recall_p10": 1.0,
        # Claimed the first two, true the first and the third.
        "precision_p50": 0.5,
        "recall_p50": 0.5,
        # Claimed the first, true none: nothing was missed.
        "precision_p90": 0.0,
        "recall_p90": 1.0,
    }
    assert by_hand().metrics() == pytest.approx({f"some_{name}": value for name, value in expected.items()})


def test_bars_are_the_numbers():
    numbers, axes = by_hand().metrics(), draw(by_hand())["accuracy"].axes
    bars = [bar.get_height() for bar in axes[1].patches]
    assert bars == pytest.approx(
        [numbers[f"some_mse_{name}"] for name in ("closest", "near", "moderate", "far", "farthest")]
    )


def test_reliability_is_the_mean_over_the_reachable_states():
    """V = 0.95, 0.6, 0.4 and 0.05 are too few for more than one bin, at the means of V and of Monte Carlo."""
    axes = draw(by_hand())["accuracy"].axes[0]
    points = axes.containers[0].lines[0].get_xydata()
    assert points.tolist() == [pytest.approx([0.5, 0.475])]


def test_error_of_the_exact_value_is_the_noise():
    """The mean square of the Monte Carlo error is its variance, within 4 standard errors: of 400 squares of nearly
    normal variables of different variance, each about 1.5 times its mean."""
    numbers = measure(Accuracy(states, 128, BRIDGE), Known())
    assert numbers["exact_mse"] == pytest.approx(numbers["exact_noise"], rel=4 * 1.9 / 400**0.5)
    tau, x = states().tau.double(), states().x.double()
    exact = Known().value(tau, x)
    deviation = (exact * (1 - exact)).mean().item() / (128 * len(x))
    assert numbers["exact_success"] == pytest.approx(exact.mean().item(), abs=4 * deviation**0.5)


def test_error_of_a_known_offset():
    """An offset of 0.2 is in the raw V everywhere, in the masked V where it is not known; 0.1 of slack for the product
    of offset and Monte Carlo error."""
    exact, wrong = (measure(Accuracy(states, 128, BRIDGE), Known(offset)) for offset in (0.0, 0.2))
    assert wrong["exact_mse_band"] - exact["exact_mse_band"] == pytest.approx(0.04, rel=0.1)
    lost = states().x[:, 0] < -1
    assert wrong["exact_mse"] - exact["exact_mse"] == pytest.approx(0.04 * (~lost).float().mean().item(), rel=0.1)
    assert wrong["exact_raw_mse"] > exact["exact_raw_mse"] + 0.035
    assert wrong["exact_success"] == exact["exact_success"]


def test_simulators_differ_and_calls_repeat():
    """Watching at end points only misses some hits. The simulator that is handed to all evaluators plays no part."""
    evaluator = Accuracy(states, 64, BRIDGE | {"coarse": {"dt": 0.1, "substeps": 1, "crossing": "endpoint"}})
    first, again = measure(evaluator, Known()), measure(evaluator, Known(), dt=0.5)
    assert first == again
    assert first["coarse_success"] < first["exact_success"] - 0.01


def test_evidence_is_drawn_by_its_class():
    evidence = Accuracy(states, 2, BRIDGE)(Known(), Simulator(Known().problem))
    assert draw(Metrics({"some": 1.0})) == {}
    assert list(draw_all({"numbers": Metrics({"some": 1.0}), "accuracy": evidence})) == ["accuracy"]


class Mine(Metrics):
    """A class of evidence that is not part of the package."""


def test_a_class_of_evidence_registers_what_draws_it():
    @draw.register
    def draw_mine(evidence: Mine) -> dict[str, Figure]:
        return {"mine": Figure()}

    assert list(draw_all({"a": Metrics({}), "b": Mine({})})) == ["mine"]


def test_accuracy_and_calibration_are_one_estimator():
    """On the same points and noise, both have the same errors."""
    calibration = Calibration(50, 16)(Known(0.1), Simulator(Known().problem))
    points = calibration.comparison
    reference = ReferenceStates(points.tau, points.x, torch.arange(50.0), torch.arange(50) // 10)
    accuracy = measure(Accuracy(lambda: reference, 16, {"same": {"dt": 0.1}}), Known(0.1))
    assert calibration.metrics() == {
        f"calibration_{name}": accuracy[f"same_{name}"] for name in ("mse", "mae", "noise")
    }


def test_every_metric_of_the_drifting_problem_has_a_meaning():
    class Hold:
        problem, dtype, device = VehicleDrift(), torch.float32, torch.device("cpu")

        def policy(self, tau, x):
            return torch.tensor([0.0, 2300.0]).expand(len(x), 2)

        def raw_value(self, tau, x):
            return torch.zeros_like(tau)

        value = raw_value

    evaluator = Accuracy(states_of_drift, 2)
    meanings = evaluator.meanings(Hold.problem)
    assert list(measure(evaluator, Hold())) == list(meanings)
    assert {name.partition("_")[0] for name in meanings} == {"fine", "paper"}


def states_of_drift() -> ReferenceStates:
    x = VehicleDrift().around_equilibrium(torch.linspace(0.5, 0.6, 10), e_y=torch.linspace(0.5, 1.5, 10))
    return ReferenceStates(torch.ones(10), x, torch.arange(10.0), torch.arange(10) // 2)


def test_too_few_rollouts_are_refused():
    with pytest.raises(ValueError, match="Accuracy: expected rollouts >= 2, got 1"):
        Accuracy(states, 1)
