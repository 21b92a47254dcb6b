"""A bound on a probability that holds at every number of trials at once, so that one may stop at any of them."""

from __future__ import annotations

import math

from scipy.optimize import brentq
from scipy.special import betaln

PRIOR = 0.5
"""Both parameters of the beta distribution over which the likelihood is averaged."""


def anytime_lower_bound(successes: int, trials: int, confidence: float) -> float:
    """The lower end of the confidence sequence by H. Robbins, Ann. Math. Stat. 41, 1970, for independent trials.

    For s successes in n trials, the likelihood averaged over q ~ Beta(1/2, 1/2), divided by that of p, is

        M_n(p) = B(s + 1/2, n - s + 1/2) / (B(1/2, 1/2) p^s (1 - p)^(n - s)).

    If p is the true probability, then M_n(p) is a martingale that starts at 1. By Ville's inequality it ever reaches
    1/alpha with a probability of at most alpha = 1 - confidence. The bound is the smallest p at which it has not, so
    that it ever exceeds the true probability with a probability of at most alpha.

    Args:
        successes: the number s of successes, in [0, trials].
        trials: the number n of trials.
        confidence: the level in (0, 1), one-sided.
    """
    if not successes:
        return 0.0
    failures = trials - successes
    evidence = betaln(successes + PRIOR, failures + PRIOR) - betaln(PRIOR, PRIOR) + math.log(1 - confidence)

    def excess(p: float) -> float:
        """log(alpha M_n(p)), which falls with p up to s/n, where it is negative."""
        return evidence - successes * math.log(p) - (failures * math.log1p(-p) if failures else 0.0)

    smallest = math.exp((evidence - 1) / successes)  # where excess >= 1, since log1p(-p) <= 0
    return brentq(excess, smallest, successes / trials)  # type: ignore[return-value]


def anytime_upper_bound(successes: int, trials: int, confidence: float) -> float:
    """The upper end of the same sequence, see `anytime_lower_bound`."""
    return 1 - anytime_lower_bound(trials - successes, trials, confidence)
