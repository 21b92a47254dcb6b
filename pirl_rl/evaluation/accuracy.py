"""How far the value is from what its policy attains, on reference states: the paper's table of accuracy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evidence import Measurement, like, rng_like
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.evaluation.reference_states import GROUPS, ReferenceStates
from pirl_rl.figures.evidence import draw_accuracy
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

SIMULATORS: dict[str, dict[str, Any]] = {
    "fine": {"dt": 0.1, "substeps": 10, "crossing": "endpoint"},
    "paper": {"dt": 0.1, "substeps": 1, "crossing": "endpoint"},
}
LEVELS = (0.1, 0.5, 0.9)
"""p of the sets {V > p}."""

MEANINGS = {
    "mse": "mean square of masked V minus Monte Carlo of the learned policy on the reference states, 256 paths each",
    "mae": "mean absolute value of the same difference",
    "noise": "the mean square that a perfect V would have there: the variance of the Monte Carlo mean",
    "raw_mse": "as mse, of the raw network's V",
    "mse_band": "as mse, over the states from which the target can be reached (drift: friction inside the band)",
    **{f"mse_{group}": f"as mse, over fifth {i + 1} of the states by distance" for i, group in enumerate(GROUPS)},
    "success": "mean of that Monte Carlo over the reference states",
    "success_band": "the same over the states from which the target can be reached",
    **{f"precision_p{100 * p:.0f}": f"share of states with V > {p} that Monte Carlo > {p} confirms" for p in LEVELS},
    **{f"recall_p{100 * p:.0f}": f"share of states with Monte Carlo > {p} that V > {p} finds" for p in LEVELS},
}
"""Each with the name of a simulator before it."""


@dataclass(frozen=True)
class AccuracyEvidence:
    """On N reference states: V (N,) masked and raw, which of them can reach the target, (N,) bool, and by simulator
    the mean payoff (N,) of `rollouts` paths each, float64, all on the CPU."""

    states: ReferenceStates
    value: Tensor
    raw_value: Tensor
    reachable: Tensor
    monte_carlo: dict[str, Tensor]
    rollouts: int

    def numbers(self) -> dict[str, float]:
        return {f"{name}_{key}": value for name in self.monte_carlo for key, value in self.numbers_of(name).items()}

    def numbers_of(self, simulator: str) -> dict[str, float]:
        """The metrics of one simulator, named as in `MEANINGS`."""
        mean, band = self.monte_carlo[simulator], self.reachable
        error = self.value - mean
        square = error.square()
        numbers = {
            "mse": square.mean(),
            "mae": error.abs().mean(),
            "noise": (mean * (1 - mean)).mean() / (self.rollouts - 1),
            "raw_mse": (self.raw_value - mean).square().mean(),
            "mse_band": square[band].mean(),
            **{f"mse_{group}": square[self.states.group == i].mean() for i, group in enumerate(GROUPS)},
            "success": mean.mean(),
            "success_band": mean[band].mean(),
        }
        for p in LEVELS:
            claimed, true = self.value > p, mean > p
            numbers[f"precision_p{100 * p:.0f}"] = _share(claimed & true, claimed)
            numbers[f"recall_p{100 * p:.0f}"] = _share(claimed & true, true)
        return {name: value.item() for name, value in numbers.items()}

    def figures(self) -> dict[str, Figure]:
        return {"accuracy": draw_accuracy(self)}


class Accuracy(Measurement):
    """V against the mean payoff of noise-free rollouts on the same states for every solution, under several simulators.

    Args:
        states: gives the reference states.
        rollouts: paths from each, at least 2.
        simulators: dt, substeps and crossing of each, by the name that its metrics begin with; default `SIMULATORS`.
        seed: of the noise.
    """

    def __init__(
        self,
        states: Callable[[], ReferenceStates],
        rollouts: int = 256,
        simulators: Mapping[str, Mapping[str, Any]] | None = None,
        seed: int = 0,
    ):
        if rollouts < 2:
            raise ArgumentError(f"Accuracy: expected rollouts >= 2, got {rollouts}")
        self.states, self.rollouts, self.simulators, self.seed = states, rollouts, simulators or SIMULATORS, seed

    def measure(self, solution: Solution) -> AccuracyEvidence:
        states, problem = self.states(), solution.problem
        tau, x = like(solution, states.tau, states.x)
        means = {}
        for name, settings in self.simulators.items():
            simulator, noise = Simulator(problem, **settings), rng_like(solution, self.seed)
            means[name] = mean_payoff(simulator, solution.policy, tau, x, self.rollouts, noise).cpu()
        value, raw = (function(tau, x).cpu().double() for function in (solution.value, solution.raw_value))
        return AccuracyEvidence(states, value, raw, ~problem.unreachable(x).cpu(), means, self.rollouts)


def _share(part: Tensor, whole: Tensor) -> Tensor:
    """Share of `whole` that is `part`, both bool; 1 of an empty one, where nothing is wrong."""
    return part.double().sum() / whole.sum() if whole.any() else torch.ones(())
