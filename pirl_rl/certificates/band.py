"""A band around V that contains the policy's probability of success at almost all states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pirl_rl.certificates.bounds import order_of_quantile
from pirl_rl.certificates.claim import Claim, Level
from pirl_rl.certificates.deployed import Deployed, Rngs, Starts
from pirl_rl.certificates.states import States
from pirl_rl.errors import ArgumentError


@dataclass(frozen=True)
class ValueBand(States):
    """|V - P(success)| <= eps at all but a share of the states that a law of starts draws.

    At each of N states the score max(V - lower, upper - V), with bounds of the probability of success, is below the
    error of V with a probability of at most `MISSED`. So if more than the share have an error above eps, more than
    `shown` of them have a score above eps, and eps is an order statistic of the scores (V. Vovk, A. Gammerman and
    G. Shafer, Algorithmic Learning in a Random World, 2005; S. S. Wilks, 1941).
    """

    def check(self, starts: Starts, level: Level) -> None:
        """Refuse a single start, and fewer states than the order statistic needs."""
        super().check(starts, level)
        if order_of_quantile(self.states, self.shown, level.each) is None:
            raise ArgumentError(
                f"states: expected more of them for a claim about all but {self.share:g} with confidence "
                f"{level.confidence:g}, got {self.states}"
            )

    def __call__(self, deployed: Deployed, starts: Starts, level: Level, rngs: Rngs) -> Claim:
        order = order_of_quantile(self.states, self.shown, level.each)
        assert order is not None  # as checked
        found = self.play(deployed, starts, rngs)
        scores = np.maximum(found.value - found.lower, found.upper - found.value)
        eps = float(np.sort(scores)[order - 1])
        gap = float(np.abs(found.value - found.mean).mean())
        return Claim(
            bounded=f"the distance of V from the policy's probability of success at all but {self.share:.1%} of "
            f"{starts.describe()}",
            method="Clopper and Pearson 1934 at each state; order statistic of their scores, Wilks 1941",
            confidence=level.confidence,
            estimate=gap,
            lower=None,
            upper=eps,
            samples=self.states,
            paths=self.states * self.rollouts,
            holds=True,
            sentences=(
                f"{level.words()} V is within {eps:.4f} of the policy's probability of success at all but "
                f"{self.share:.1%} of {starts.describe()}.",
                f"At {self.states:,} states, {self.rollouts:,} paths were played from each {deployed.words()}.",
                f"The mean distance of V from their share of successes is {gap:.4f}, noise included.",
            ),
        )
