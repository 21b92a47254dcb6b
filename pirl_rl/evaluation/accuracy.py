"""The error of the value against Monte Carlo of its policy on reference states, as in the paper's table of accuracy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.inputs import like
from pirl_rl.evaluation.reference_states import GROUPS, ReferenceStates
from pirl_rl.evaluation.rollout_comparison import RolloutComparison
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

SIMULATORS: dict[str, dict[str, Any]] = {
    "fine": {"dt": 0.1, "substeps": 10, "crossing": "endpoint"},
    "paper": {"dt": 0.1, "substeps": 1, "crossing": "endpoint"},
}
LEVELS = (0.1, 0.5, 0.9)
"""The levels p of the sets {V > p} for which precision and recall are computed."""


@dataclass(frozen=True)
class AccuracyEvidence:
    """V and Monte Carlo on N reference states.

    Attributes:
        states: the reference states.
        reachable: False where the problem knows that the target is out of reach, (N,) bool, on the CPU.
        comparisons: V against Monte Carlo under each simulator, by the simulator's name.
    """

    states: ReferenceStates
    reachable: Tensor
    comparisons: Mapping[str, RolloutComparison]

    def metrics(self) -> dict[str, float]:
        return {f"{name}_{key}": value for name in self.comparisons for key, value in self.metrics_under(name).items()}

    def metrics_under(self, simulator: str) -> dict[str, float]:
        """The metrics under one simulator, by names without the simulator's prefix."""
        comparison = self.comparisons[simulator]
        metrics = {
            "mse": comparison.mse(),
            "mae": comparison.mae(),
            "noise": comparison.noise(),
            "raw_mse": comparison.raw_mse(),
            "mse_band": comparison.mse(self.reachable),
            **{f"mse_{group}": comparison.mse(self.states.group == i) for i, group in enumerate(GROUPS)},
            "success": comparison.monte_carlo.mean().item(),
            "success_band": comparison.monte_carlo[self.reachable].mean().item(),
        }
        for p in LEVELS:
            metrics[f"precision_p{100 * p:.0f}"] = comparison.precision(p)
            metrics[f"recall_p{100 * p:.0f}"] = comparison.recall(p)
        return metrics


class Accuracy:
    """Compares V with the mean payoff of rollouts on fixed reference states, under several simulators of its own.

    Args:
        states: a callable that returns the reference states.
        rollouts: number of paths from each state, at least 2.
        simulators: dt (s), substeps and crossing of each simulator, by the name with which its metrics start; the
            default is `SIMULATORS`.
        seed: seed of the noise.

    Raises:
        ArgumentError: if there are fewer than two rollouts.
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

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        return {
            f"{name}_{key}": text
            for name, settings in self.simulators.items()
            for key, text in self._meanings_under(name, Simulator(problem, **settings)).items()
        }

    def _meanings_under(self, name: str, simulator: Simulator) -> dict[str, str]:
        meanings = {
            "mse": f"The mean square of V minus Monte Carlo, the mean payoff of {self.rollouts:,} rollouts of the "
            f"policy from each reference state, with control steps of {simulator.dt:g} s, integration steps of "
            f"{simulator.dt / simulator.substeps:g} s and the exit rule {simulator.crossing}; V is 1 in A and 0 in B.",
            "mae": f"The mean absolute value of the difference in {name}_mse.",
            "noise": f"The {name}_mse that a perfect V would have: the variance of the Monte Carlo means.",
            "raw_mse": f"As {name}_mse, for the V of the networks alone.",
            "mse_band": f"As {name}_mse, over the states from which the problem does not rule the target out.",
            **{
                f"mse_{group}": f"As {name}_mse, over group {i + 1} of {len(GROUPS)} of the reference states, counted "
                "from the closest to those that a reference policy visits."
                for i, group in enumerate(GROUPS)
            },
            "success": f"The mean over the reference states of the Monte Carlo in {name}_mse.",
            "success_band": f"As {name}_success, over the states from which the problem does not rule the target out.",
        }
        for p in LEVELS:
            level = f"p{100 * p:.0f}"
            meanings[f"precision_{level}"] = f"The share of the states with V > {p} whose Monte Carlo is above {p} too."
            meanings[f"recall_{level}"] = f"The share of the states with Monte Carlo > {p} whose V is above {p} too."
        return meanings

    def __call__(self, solution: Solution, simulator: Simulator) -> AccuracyEvidence:
        """Measure a solution under the evaluator's own simulators; `simulator` says whether they may be compiled."""
        states, problem = self.states(), solution.problem
        tau, x = like(solution, states.tau, states.x)
        comparisons = {
            name: RolloutComparison.measure(
                solution, Simulator(problem, **settings, compile=simulator.compile), tau, x, self.rollouts, self.seed
            )
            for name, settings in self.simulators.items()
        }
        return AccuracyEvidence(states, ~problem.unreachable(x).cpu(), comparisons)
