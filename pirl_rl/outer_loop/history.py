"""The history of an outer loop: the results of its candidates, round by round."""

from __future__ import annotations

import math
from typing import Literal

from pirl_rl.outer_loop.plan import Candidate, Frozen, Triple


class Result(Frozen):
    """The result of a candidate, or the measured start of the loop.

    Attributes:
        checkpoint: the name by which later plans can start from it; None if there is nothing to start from.
        candidate: the candidate; None for the start of the loop.
        status: "done", "collapsed" if the guard stopped and rolled it back, or "failed" if it ended with an error.
        updates: number of updates since the start of the loop, over all candidates in between.
        metrics: the metrics of the run's summary.
        weights: the loss weights (TD, HJB, boundary) in force at the end of training.
        collocation_jitter: the jitter in force at the end of training; None if the collocation has no such setting.
        collocation_replay_share: the replay share in force at the end of training; None likewise.
        reason: why it failed or collapsed.
    """

    checkpoint: str | None
    candidate: Candidate | None = None
    status: Literal["done", "collapsed", "failed"] = "done"
    updates: int = 0
    metrics: dict[str, float] = {}
    weights: Triple
    collocation_jitter: float | None = None
    collocation_replay_share: float | None = None
    reason: str = ""


class Round(Frozen):
    """A finished round.

    Attributes:
        number: number of the round, from 1.
        advisor: name of the advisor that planned it.
        note: the advisor's note.
        fallback: why the chosen advisor gave no plan, so that `advisor` replaced it; empty if it gave one.
        results: results of the candidates, in the plan's order.
    """

    number: int
    advisor: str
    note: str
    fallback: str = ""
    results: list[Result]


class History(Frozen):
    """The history of a loop, from which an advisor plans.

    Attributes:
        baseline: the loop's start; a candidate with less reward is not sound.
        rounds: the finished rounds.
        tolerance: the difference of two rewards that statistical noise explains.
    """

    baseline: Result
    rounds: list[Round] = []
    tolerance: float

    @property
    def results(self) -> list[Result]:
        """The results of all candidates."""
        return [result for one in self.rounds for result in one.results]

    @property
    def best(self) -> Result:
        """The sound result, or the baseline, with the lowest calibration_mae."""
        sound = [self.baseline, *(result for result in self.results if self.keeps(result))]
        return min(sound, key=lambda result: result.metrics["calibration_mae"])

    def keeps(self, result: Result) -> bool:
        """Whether a result is sound: it is done and measured, and its reward is not below the baseline's by more than
        noise."""
        measured = result.checkpoint is not None and {"reward", "calibration_mae"} <= result.metrics.keys()
        least = self.baseline.metrics["reward"] - self.tolerance
        return result.status == "done" and measured and result.metrics["reward"] >= least

    @property
    def checkpoints(self) -> dict[str, Result]:
        """The results from which a plan may start, by the names of their checkpoints."""
        results = (self.baseline, *self.results)
        return {result.checkpoint: result for result in results if result.checkpoint is not None}


def tolerance(baseline: Result) -> float:
    """The half-width of the 95% interval of the difference of two success rates like the baseline's."""
    low, high = (baseline.metrics[name] for name in ("success_low", "success_high"))
    return math.sqrt(2) * (high - low) / 2
