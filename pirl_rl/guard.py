"""The guard: notices in the evaluations of a run that training has collapsed, and brings back what it had learned."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

from pirl_rl.errors import ArgumentError, CollapseError
from pirl_rl.evaluation import Evaluator, Success
from pirl_rl.learner import Learner
from pirl_rl.simulator import Simulator

RATES = ("success_rate", "reward")
SPREAD = "value_spread"

LEAST_SPREAD = 0.2
"""A spread of V below this is no baseline: untrained networks have as much by chance."""


GOOD = 2.0
"""Deviations below the baseline within which an evaluation is as good: 19 of 20 that truly are fall into it."""


class Guard:
    """Compares evaluations with the baseline: the first one, and afterwards the one of the highest success rate.

    The success rate or the reward has collapsed where it is below the baseline by more than `sigmas` deviations of the
    difference of two such means, and by more than `tolerance` of the baseline, as training moves them by a few per
    cent from one evaluation to the next. The deviation is that of binomial rates of independent episodes: an upper
    bound, since payoffs in [0, 1] vary no more and all evaluations share their starts. For the same reason the spread
    of V has no such noise.

    Args:
        episodes: of each evaluation.
        sigmas: deviations that count as noise.
        tolerance: relative loss of a rate that is no collapse.
        spread: part of the baseline's standard deviation of V over the starts below which V has collapsed.
    """

    def __init__(self, episodes: int, sigmas: float = 4.0, tolerance: float = 0.2, spread: float = 0.5):
        self.episodes, self.sigmas, self.tolerance, self.spread = episodes, sigmas, tolerance, spread
        self.baseline: dict[str, float] = {}

    def judge(self, metrics: Mapping[str, float]) -> bool:
        """Whether success and reward are those of the baseline, but for `GOOD` deviations, or better.

        Raises:
            CollapseError: they, or the spread of V, collapsed; a metric that is NaN did.
        """
        now = {name: metrics[name] for name in (*RATES, SPREAD)}
        if not self.baseline:
            self.baseline = now
            return True
        lost = {name: self.baseline[name] - now[name] for name in RATES}
        deviation = {name: self._deviation(name, now) for name in RATES}
        fallen = [
            name
            for name in RATES
            if not lost[name] <= max(self.sigmas * deviation[name], self.tolerance * self.baseline[name])
        ]
        spread = self.baseline[SPREAD]
        if spread >= LEAST_SPREAD and not now[SPREAD] >= self.spread * spread:
            fallen.append(SPREAD)
        if fallen:
            raise CollapseError(
                ", ".join(f"{name} from {self.baseline[name]:.3g} to {now[name]:.3g}" for name in fallen)
            )
        if now["success_rate"] > self.baseline["success_rate"]:
            self.baseline = now
        return all(lost[name] <= GOOD * deviation[name] for name in RATES)

    def _deviation(self, name: str, now: Mapping[str, float]) -> float:
        pooled = (self.baseline[name] + now[name]) / 2
        return math.sqrt(2 * max(pooled * (1 - pooled), 0.0) / self.episodes)


class Rollback:
    """Keeps what a learner was at its last good evaluation, one within noise of the best, and brings it back.

    Attributes:
        good_at: the update of what is kept; None before the first evaluation.
        collapsed_at: the update after which a collapse was noticed; None without one.
    """

    def __init__(self, learner: Learner, success: Success, simulator: Simulator):
        self.learner, self.success, self.simulator = learner, success, simulator
        self.guard = Guard(success.episodes)
        self.good: dict[str, Any] = {}
        self.good_at: int | None = None
        self.collapsed_at: int | None = None

    @classmethod
    def of(
        cls, learner: Learner, during: Mapping[str, Evaluator], simulator: Simulator, evaluate_every: int
    ) -> Rollback:
        """The rollback of a run with these evaluators.

        Raises:
            ArgumentError: no evaluation of success during training, by which it could judge.
        """
        success = next((one for one in during.values() if isinstance(one, Success)), None)
        if success is None or not evaluate_every:
            raise ArgumentError(
                "trainer.rollback: it judges evaluations during training, expected trainer.evaluate_every >= 1 and "
                f"success in evaluation.during, got {evaluate_every} and {list(during)}"
            )
        return cls(learner, success, simulator)

    def judge(self, update: int, row: Mapping[str, float] | None = None) -> None:
        """Look at the networks after an update, through the row's metrics where it has them.

        Raises:
            CollapseError: see `Guard`.
        """
        metrics = row
        if not metrics or "success_rate" not in metrics:
            metrics = self.success(self.learner.loss.solution(), self.simulator).metrics()
        if self.guard.judge(metrics):
            # With the optimisers: those of a collapse would spoil what starts from here.
            self.good, self.good_at = copy.deepcopy(self.learner.state_dict()), update

    def restore(self, update: int) -> None:
        """Put the learner back, after a collapse noticed at an update."""
        self.learner.load_state_dict(self.good)
        self.collapsed_at = update

    def summary(self) -> dict[str, int]:
        """Updates of the collapse and of what was put back; empty without a collapse."""
        if self.collapsed_at is None or self.good_at is None:
            return {}
        return {"collapsed_at": self.collapsed_at, "rolled_back_to": self.good_at}

    def state_dict(self) -> dict[str, Any]:
        return {
            "baseline": self.guard.baseline,
            "good": self.good,
            "good_at": self.good_at,
            "collapsed_at": self.collapsed_at,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.guard.baseline, self.good = state["baseline"], state["good"]
        self.good_at, self.collapsed_at = state["good_at"], state["collapsed_at"]
