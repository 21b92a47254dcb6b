"""What has happened in a loop: results of candidates, round by round."""

from __future__ import annotations

import math
from typing import Literal

from pirl_rl.outer_loop.plan import Candidate, Frozen, Triple


class Result(Frozen):
    """What became of a candidate, or of the start itself (`candidate` None).

    Attributes:
        checkpoint: the name under which later plans may start from it; None where there is nothing to start from.
        status: "done"; "collapsed", stopped by the guard and rolled back; "failed", ended with an error.
        updates: number of updates of the whole chain since the loop's start.
        metrics: the numbers of the run's summary.
        weights: the loss weights (TD, HJB, boundary) in force at the end of training.
        collocation_jitter, collocation_replay_share: the same for the collocation; None where it has no such setting.
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
    """A finished round."""

    number: int
    advisor: str
    note: str
    fallback: str = ""  # why `advisor` had to step in for the one that was asked
    results: list[Result]


class History(Frozen):
    """All that happened; what an advisor decides upon.

    Attributes:
        baseline: the loop's start, which no candidate may fall behind in reward.
        rounds: finished ones.
        tolerance: how much lower a reward may be before it counts as worse: its statistical noise.
    """

    baseline: Result
    rounds: list[Round] = []
    tolerance: float

    @property
    def results(self) -> list[Result]:
        return [result for one in self.rounds for result in one.results]

    @property
    def best(self) -> Result:
        """The lowest calibration_mae among those that are no worse than the baseline in reward."""
        sound = [self.baseline, *(result for result in self.results if self.keeps(result))]
        return min(sound, key=lambda result: result.metrics["calibration_mae"])

    def keeps(self, result: Result) -> bool:
        """Whether a result is sound: done, measured, and no worse than the baseline in reward by more than noise."""
        measured = result.checkpoint is not None and {"reward", "calibration_mae"} <= result.metrics.keys()
        least = self.baseline.metrics["reward"] - self.tolerance
        return result.status == "done" and measured and result.metrics["reward"] >= least

    @property
    def checkpoints(self) -> dict[str, Result]:
        """All that a plan may start from, by name."""
        return {one.checkpoint: one for one in (self.baseline, *self.results) if one.checkpoint is not None}


def tolerance(baseline: Result) -> float:
    """The 95% half-width of the difference of two success rates such as the baseline's."""
    low, high = (baseline.metrics[name] for name in ("success_low", "success_high"))
    return math.sqrt(2) * (high - low) / 2
