"""Exact confidence bounds on probabilities and quantiles, which hold for every number of samples."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import bdtr, betaincinv

from pirl_rl.errors import ArgumentError


def lower_bound(successes: ArrayLike, trials: int, confidence: float) -> np.ndarray:
    """The lower bound on a probability by C. J. Clopper and E. S. Pearson, Biometrika 26, 1934.

    It is the smallest p with P(Bin(trials, p) >= successes) >= 1 - confidence, so that it exceeds the true probability
    with a probability of at most 1 - confidence, whatever that is.

    Args:
        successes: numbers of successes (*), each in [0, trials].
        trials: the number of independent trials, at least 1.
        confidence: the level in (0, 1), one-sided.

    Returns:
        The bounds (*); without a success the bound is 0.

    Raises:
        ArgumentError: there is no trial, a number of successes is impossible, or the level is not in (0, 1).
    """
    count = _checked(successes, trials, confidence)
    return np.where(count > 0, betaincinv(np.maximum(count, 1), trials - count + 1, 1 - confidence), 0.0)


def upper_bound(successes: ArrayLike, trials: int, confidence: float) -> np.ndarray:
    """The upper bound on a probability, see `lower_bound`; without a failure it is 1."""
    return 1 - lower_bound(trials - np.asarray(successes), trials, confidence)


def order_of_quantile(samples: int, share: float, confidence: float) -> int | None:
    """The order k of the sample that bounds a quantile from above, by S. S. Wilks, Ann. Math. Stat. 12, 1941.

    With the given confidence, at most the share `share` of the distribution lies above the k-th smallest of so many
    independent samples. That sample is below the quantile only if at least k samples are, and each of them is with a
    probability of at most 1 - share.

    Args:
        samples: the number of samples.
        share: the share that may lie above the bound, in (0, 1).
        confidence: the level in (0, 1).

    Returns:
        k in 1, ..., samples, or None where there are too few samples for any bound.
    """
    # The probabilities that at most 0, 1, ... of the samples are below the quantile.
    at_most = bdtr(np.arange(samples + 1.0), samples, 1 - share)
    order = int(np.searchsorted(at_most, confidence)) + 1
    return order if order <= samples else None


def mean_margin(samples: int, width: float, confidence: float) -> float:
    """The distance by which a mean may exceed the expectation, by W. Hoeffding, J. Am. Stat. Assoc. 58, 1963.

    Args:
        samples: the number of independent samples.
        width: the length of an interval that contains all of them.
        confidence: the level in (0, 1), one-sided.
    """
    return width * math.sqrt(-math.log(1 - confidence) / (2 * samples))


def _checked(successes: ArrayLike, trials: int, confidence: float) -> np.ndarray:
    count = np.asarray(successes, dtype=float)
    if not (trials >= 1 and bool(((count >= 0) & (count <= trials)).all())):
        raise ArgumentError(f"successes: expected numbers in [0, trials] and trials >= 1, got {successes} of {trials}")
    check_level("confidence", confidence)
    return count


def check_level(name: str, value: float) -> None:
    """Refuse a level or a share that is not between 0 and 1.

    Raises:
        ArgumentError: with the name of the argument.
    """
    if isinstance(value, bool) or not (isinstance(value, Real) and 0 < value < 1):
        raise ArgumentError(f"{name}: expected a number between 0 and 1, got {value!r}")
