"""A lower bound on the probability that the policy succeeds."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from pirl_rl.arguments import check_integer
from pirl_rl.certificates.bounds import check_level, lower_bound, mean_margin
from pirl_rl.certificates.claim import Claim, Level
from pirl_rl.certificates.deployed import Deployed, Rngs, Starts
from pirl_rl.certificates.sequence import anytime_lower_bound, anytime_upper_bound

FIRST = 1_000
"""The number of episodes before the first look of a certificate that may stop early; each later look doubles it."""


@dataclass(frozen=True)
class SuccessBound:
    """P(success) >= p from a start or from a law of starts, one episode each.

    Without `at_least` the number of episodes is fixed, and the bound is that of Clopper and Pearson. With it, the
    episodes end as soon as the bound reaches `at_least`, or when it no longer can; the bound is then one that holds at
    every number of episodes.

    The same episodes test V: if V is the policy's probability of success, then the mean of V minus success over the
    starts has expectation 0.

    Args:
        episodes: the number of episodes, or the largest one.
        at_least: the probability to be proved, in (0, 1).

    Raises:
        ArgumentError: there is no episode, or `at_least` is no probability.
    """

    episodes: int = 100_000
    at_least: float | None = None

    def __post_init__(self):
        check_integer("episodes", self.episodes, 1)
        if self.at_least is not None:
            check_level("at_least", self.at_least)

    def check(self, starts: Starts, level: Level) -> None:
        """Nothing is refused: any starts and any level will do."""

    def __call__(self, deployed: Deployed, starts: Starts, level: Level, rngs: Rngs) -> Claim:
        tau, x = starts.draw(deployed, self.episodes, rngs.starts)
        played, successes, lower = self._play(deployed, tau, x, level.each, rngs)
        promised = float(deployed.value(tau[:played], x[:played]).mean())
        success = successes / played
        margin = mean_margin(played, 2.0, 1 - (1 - level.each) / (2 * self._looks))
        verb = "is refuted" if abs(promised - success) > margin else "is not refuted"
        where = starts.describe()
        return Claim(
            bounded=f"the probability that the policy succeeds from {where}",
            method="Clopper and Pearson 1934" if self.at_least is None else "Robbins 1970, at every number of episodes",
            confidence=level.confidence,
            estimate=success,
            lower=lower,
            upper=None,
            samples=played,
            paths=played,
            holds=self.at_least is None or lower >= self.at_least,
            sentences=(
                f"{level.words()} the policy succeeds with probability at least {lower:.4f} from {where}.",
                f"It did in {successes:,} of {played:,} episodes {deployed.words()}.",
                f"The mean of V over these starts, {promised:.4f}, {verb} by the episodes (margin {margin:.4f}).",
            ),
            numbers={"value": promised, "value_margin": margin},
        )

    @property
    def _looks(self) -> int:
        """The largest number of times at which the episodes may end."""
        return 1 if self.at_least is None else 1 + math.ceil(math.log2(max(1, self.episodes / FIRST)))

    def _play(self, deployed: Deployed, tau: Tensor, x: Tensor, confidence: float, rngs: Rngs):
        """The numbers of episodes and of successes, and the lower bound."""
        if self.at_least is None:
            successes = int(deployed.successes(tau, x, 1, rngs.noise).sum())
            return self.episodes, successes, float(lower_bound(successes, self.episodes, confidence))
        played, successes, look = 0, 0, min(FIRST, self.episodes)
        while True:
            successes += int(deployed.successes(tau[played:look], x[played:look], 1, rngs.noise).sum())
            played, lower = look, anytime_lower_bound(successes, look, confidence)
            hopeless = anytime_upper_bound(successes, look, confidence) < self.at_least
            if lower >= self.at_least or hopeless or played == self.episodes:
                return played, successes, lower
            look = min(2 * look, self.episodes)
