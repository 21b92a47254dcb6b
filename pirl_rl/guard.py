"""Detection of a collapse of training in its evaluations, and the rollback to the last good networks."""

from __future__ import annotations

import copy
import math
import sys
from collections.abc import Mapping
from typing import Any

from pirl_rl.errors import ArgumentError, CollapseError
from pirl_rl.evaluation import Evaluator, Success
from pirl_rl.learner import Learner
from pirl_rl.simulator import Simulator

RATES = ("success_rate", "reward")
SPREAD = "value_spread"

LEAST_SPREAD = 0.2
"""A smaller standard deviation of V is no baseline, because untrained networks may have it by chance."""

GOOD = 2.0
"""An evaluation is good if it is at most this many standard deviations below the baseline; of equally good policies,
about 19 in 20 evaluations are."""


class Guard:
    """Compares evaluations with a baseline: the evaluation with the highest success rate, at first the first one.

    The success rate or the reward has collapsed if it is below the baseline by more than `sigmas` standard deviations
    of the difference of the two estimates and by more than the share `tolerance` of the baseline, since training moves
    both by a few per cent between evaluations. The standard deviation is that of binomial rates of independent
    episodes. It is an upper bound, because payoffs in [0, 1] have no larger variance and all evaluations start from the
    same states. V at these states has no sampling noise, so its spread is compared without one.

    Args:
        episodes: the number of episodes of each evaluation.
        sigmas: the number of standard deviations that count as noise.
        tolerance: the relative loss of a rate that is not a collapse.
        spread: V has collapsed if its standard deviation over the initial states is below this share of the baseline's.
    """

    def __init__(self, episodes: int, sigmas: float = 4.0, tolerance: float = 0.2, spread: float = 0.5):
        self.episodes, self.sigmas, self.tolerance, self.spread = episodes, sigmas, tolerance, spread
        self.baseline: dict[str, float] = {}

    def judge(self, metrics: Mapping[str, float]) -> bool:
        """Whether success rate and reward are at most `GOOD` standard deviations below the baseline.

        Args:
            metrics: the metrics of an evaluation; "success_rate", "reward" and "value_spread" are read.

        Raises:
            CollapseError: the success rate, the reward or the spread of V has collapsed or is NaN.
        """
        current = {name: metrics[name] for name in (*RATES, SPREAD)}
        if not self.baseline:
            self.baseline = current
            return True
        lost = {name: self.baseline[name] - current[name] for name in RATES}
        deviation = {name: self._standard_deviation(name, current) for name in RATES}
        fallen = [
            name
            for name in RATES
            if not lost[name] <= max(self.sigmas * deviation[name], self.tolerance * self.baseline[name])
        ]
        spread = self.baseline[SPREAD]
        if spread >= LEAST_SPREAD and not current[SPREAD] >= self.spread * spread:
            fallen.append(SPREAD)
        if fallen:
            raise CollapseError(
                ", ".join(f"{name} from {self.baseline[name]:.3g} to {current[name]:.3g}" for name in fallen)
            )
        if current["success_rate"] > self.baseline["success_rate"]:
            self.baseline = current
        return all(lost[name] <= GOOD * deviation[name] for name in RATES)

    def _standard_deviation(self, name: str, current: Mapping[str, float]) -> float:
        pooled = (self.baseline[name] + current[name]) / 2
        return math.sqrt(2 * max(pooled * (1 - pooled), 0.0) / self.episodes)


class Rollback:
    """Keeps the state of a learner at its last good evaluation, and restores it after a collapse.

    Args:
        learner: the learner.
        success: the evaluator whose metrics are judged.
        simulator: simulates the episodes of the evaluator.

    Attributes:
        good_at: the update after which the state was kept; None before the first evaluation.
        collapsed_at: the update after which a collapse was detected; None without one.
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
        # Of several, the metrics of the last one stand in the rows that are judged.
        success = next((one for one in reversed([*during.values()]) if isinstance(one, Success)), None)
        if success is None or not evaluate_every:
            raise ArgumentError(
                "trainer.rollback: it judges evaluations during training, expected trainer.evaluate_every >= 1 and "
                f"success in evaluation.during, got {evaluate_every} and {list(during)}"
            )
        return cls(learner, success, simulator)

    def judge(self, update: int, row: Mapping[str, float] | None = None) -> None:
        """Judge the networks after an update, and keep the state of the learner if they are good.

        Args:
            update: the number of updates made.
            row: the metrics of that update; without a success rate among them, the networks are evaluated.

        Raises:
            CollapseError: training has collapsed, see `Guard`.
        """
        metrics = row
        if not metrics or "success_rate" not in metrics:
            metrics = self.success(self.learner.loss.solution(), self.simulator).metrics()
        if self.guard.judge(metrics):
            # The optimisers are kept too, because their moments after a collapse would harm further training.
            self.good, self.good_at = copy.deepcopy(self.learner.state_dict()), update

    def restore(self, update: int, reason: str) -> None:
        """Restore the state that was kept, and say so.

        Args:
            update: the number of updates after which the collapse was detected.
            reason: what collapsed.
        """
        self.learner.load_state_dict(self.good)
        self.collapsed_at = update
        print(
            f"training collapsed at update {update}: {reason}; the networks of update {self.good_at} are restored, and "
            "the run ends with them",
            file=sys.stderr,
            flush=True,
        )

    def summary(self) -> dict[str, int]:
        """The updates of the collapse and of the state that was restored; empty without a collapse."""
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
