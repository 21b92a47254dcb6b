"""What an evaluator is, and what comes of it.

An evaluator measures a `Solution`. It says what each of its metrics means, and returns evidence: data, from which
metrics are computed here and figures are drawn in `pirl_rl.figures`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class Evidence(Protocol):
    """What was measured."""

    def metrics(self) -> dict[str, float]:
        """The numbers that sum it up, by name."""
        ...


class Evaluator(Protocol):
    """Measures a solution without exploration noise; it keeps no state, so that every call repeats the one before."""

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        """A sentence for each metric that the evaluator has for this problem."""
        ...

    def __call__(self, solution: Solution, simulator: Simulator) -> Evidence:
        """Measure a solution.

        Args:
            solution: the value and the policy.
            simulator: plays the paths, of the solution's own problem.
        """
        ...


@dataclass(frozen=True)
class Metrics:
    """Evidence that is nothing but its metrics."""

    values: Mapping[str, float]

    def metrics(self) -> dict[str, float]:
        return dict(self.values)


def evaluate(solution: Solution, simulator: Simulator, evaluators: Mapping[str, Evaluator]) -> dict[str, Evidence]:
    """The evidence of every evaluator, by the evaluator's name, in their order."""
    return {name: evaluator(solution, simulator) for name, evaluator in evaluators.items()}


def metrics_of(evidence: Mapping[str, Evidence]) -> dict[str, float]:
    """The metrics of all evidence in one dictionary, in its order."""
    return {name: value for one in evidence.values() for name, value in one.metrics().items()}


def meanings_of(evaluators: Mapping[str, Evaluator], problem: ReachAvoidProblem) -> dict[str, str]:
    """What every metric of the evaluators means for a problem, one sentence or more each."""
    return {name: text for evaluator in evaluators.values() for name, text in evaluator.meanings(problem).items()}
