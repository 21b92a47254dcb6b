"""The interfaces of evaluators and of the evidence that they return.

An evaluator measures a `Solution` and states what each of its metrics means. The evidence that it returns is data, from
which metrics are computed here and figures are drawn in `pirl_rl.figures`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class Evidence(Protocol):
    """The data that an evaluator measured."""

    def metrics(self) -> dict[str, float]:
        """The metrics that are computed from the data, by name."""
        ...


class Evaluator(Protocol):
    """Measures a solution without exploration noise; it keeps no state, so that equal calls give equal evidence."""

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        """The meaning of each metric that the evaluator has for this problem, in whole sentences, by metric."""
        ...

    def __call__(self, solution: Solution, simulator: Simulator) -> Evidence:
        """Measure a solution.

        Args:
            solution: the value and the policy.
            simulator: plays the paths; its problem is that of the solution.
        """
        ...


@dataclass(frozen=True)
class Metrics:
    """Evidence that consists of metrics alone."""

    values: Mapping[str, float]

    def metrics(self) -> dict[str, float]:
        return dict(self.values)


def evaluate(solution: Solution, simulator: Simulator, evaluators: Mapping[str, Evaluator]) -> dict[str, Evidence]:
    """Call every evaluator; returns the evidence by the evaluators' names, in their order."""
    return {name: evaluator(solution, simulator) for name, evaluator in evaluators.items()}


def metrics_of(evidence: Mapping[str, Evidence]) -> dict[str, float]:
    """The metrics of all evidence in one dictionary, in the order of the evidence."""
    return {name: value for entry in evidence.values() for name, value in entry.metrics().items()}


def meanings_of(evaluators: Mapping[str, Evaluator], problem: ReachAvoidProblem) -> dict[str, dict[str, str]]:
    """The meanings of all metrics that the evaluators have for a problem, by evaluator and metric."""
    return {name: evaluator.meanings(problem) for name, evaluator in evaluators.items()}


@runtime_checkable
class Judged(Protocol):
    """Evidence that says in words what it means."""

    def statements(self) -> dict[str, str]:
        """Sentences for the summary, by name."""
        ...

    def lines(self) -> list[str]:
        """Lines for a person."""
        ...


def statements_of(evidence: Mapping[str, Evidence]) -> dict[str, str]:
    """The statements of all evidence that has some, in one dictionary."""
    judged = [entry for entry in evidence.values() if isinstance(entry, Judged)]
    return {name: text for entry in judged for name, text in entry.statements().items()}


def lines_of(evidence: Mapping[str, Evidence]) -> list[str]:
    """The lines of all evidence that has some."""
    return [line for entry in evidence.values() if isinstance(entry, Judged) for line in entry.lines()]
