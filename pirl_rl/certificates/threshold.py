"""A threshold of V above which almost all states succeed with a wanted probability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pirl_rl.arguments import check_integer
from pirl_rl.certificates.bounds import check_level, upper_bound
from pirl_rl.certificates.claim import Claim, Level
from pirl_rl.certificates.deployed import Deployed, Rngs, Starts
from pirl_rl.certificates.states import States

CANDIDATES = 64
"""The number of thresholds that are compared, quantiles of V over the choosing half of the states."""


@dataclass(frozen=True)
class SafeThreshold(States):
    """A threshold c such that, of the states with V > c, all but a share succeed with probability at least p.

    Half of the states choose the order of the tests, the other half makes them. A state fails the test where the lower
    bound of its probability of success is below p. If more than the share of the states above c have a probability
    below p, then more than `shown` of them fail, and Clopper's and Pearson's upper bound of the share that fails
    refutes it. Thresholds are tested one after the other, from the safest down, until one is not proved, so that all
    that were proved hold together (W. Maurer, L. Hothorn and W. Lehmacher, 1995, on tests in a fixed order).

    Args:
        success: p, the wanted probability of success.

    Raises:
        ArgumentError: `success` is not between 0 and 1.
    """

    success: float = 0.9

    def __post_init__(self):
        super().__post_init__()
        check_level("success", self.success)

    def check(self, starts: Starts, level: Level) -> None:
        """Refuse a single start, and a single state, which has no half."""
        super().check(starts, level)
        check_integer("states", self.states, 2)

    def __call__(self, deployed: Deployed, starts: Starts, level: Level, rngs: Rngs) -> Claim:
        found = self.play(deployed, starts, rngs)
        fails, half = found.lower < self.success, self.states // 2
        order = self._order(found.value[:half], fails[:half], level.each)
        threshold, bound = None, 1.0
        for candidate in order:
            shown = self._bound(found.value[half:], fails[half:], candidate, level.each)
            if shown > self.shown:
                break
            threshold, bound = candidate, shown
        return self._claim(deployed, starts, level, found.value[half:], threshold, bound)

    def _order(self, value: np.ndarray, fails: np.ndarray, confidence: float) -> list[float]:
        """Thresholds from the one with the best bound on the choosing half downwards."""
        candidates = np.unique(np.quantile(value, np.linspace(0, 1, CANDIDATES, endpoint=False)))
        bounds = [self._bound(value, fails, candidate, confidence) for candidate in candidates]
        return candidates[: int(np.argmin(bounds)) + 1][::-1].tolist()

    @staticmethod
    def _bound(value: np.ndarray, fails: np.ndarray, threshold: float, confidence: float) -> float:
        """The upper bound of the share that fails the test among states with V above a threshold."""
        above = value > threshold
        return float(upper_bound(fails[above].sum(), int(above.sum()), confidence)) if above.any() else 1.0

    def _claim(
        self,
        deployed: Deployed,
        starts: Starts,
        level: Level,
        value: np.ndarray,
        threshold: float | None,
        bound: float,
    ) -> Claim:
        above = float((value > threshold).mean()) if threshold is not None else 0.0
        aim = f"all but {self.share:.1%} succeed with probability at least {self.success:g}"
        first = f"{level.words()} of {starts.describe()} with V > {threshold or 0:.4f}, {aim}."
        failed = f"No threshold of V is proved above which, of {starts.describe()}, {aim}."
        return Claim(
            bounded=f"the threshold of V above which, of {starts.describe()}, {aim}",
            method="Clopper and Pearson 1934 at each state and for the share of states; tests in a fixed order",
            confidence=level.confidence,
            estimate=None,
            lower=None,
            upper=threshold,
            samples=self.states - self.states // 2,
            paths=self.states * self.rollouts,
            holds=threshold is not None,
            sentences=(
                failed if threshold is None else first,
                f"Half of {self.states:,} states, with {self.rollouts:,} paths from each {deployed.words()}, chose the "
                "thresholds to test, and the other half tested them.",
                f"{above:.1%} of the testing half lie above it."
                if threshold is not None
                else "More states, more paths or a smaller probability may prove one.",
            ),
            numbers={"above": above, "share_bound": bound / (self.shown / self.share)},
        )
