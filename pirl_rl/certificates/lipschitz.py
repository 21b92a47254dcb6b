"""Lipschitz constants as samples show them, and what a mean then says about a maximum.

All of it is about functions of z in [-1, 1]^d with the maximum norm. A Lipschitz constant that was not proved but
sampled is an estimate: a function may be steeper where no sample fell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.special import ndtri
from torch import Tensor

STEP = 1e-4
"""The distance of the two points of a pair, in the maximum norm."""

BATCHES = 128
"""The number of maxima to which the distribution is fitted."""

GAPS = np.geomspace(1e-3, 1e3, 241)
"""Distances of the end of a distribution from the largest of the maxima, in standard deviations of the maxima."""

SHAPES = (1.0, 1e4)
"""The shapes that a fit may have. Below 1 the likelihood has no maximum; a large shape has no visible end."""


class Lipschitz(NamedTuple):
    """A Lipschitz constant as a sample of slopes shows it.

    Attributes:
        largest: the largest slope of the sample, which the constant is not below.
        estimate: the estimate of the largest slope that there is, or None where the sample shows no end.
        upper: the upper end of its approximate confidence interval, or None.
    """

    largest: float
    estimate: float | None
    upper: float | None

    @property
    def stated(self) -> float:
        """The upper end, or the largest slope where there is none."""
        return self.largest if self.upper is None else self.upper


def neighbours(z: Tensor, moves: Tensor, rng: torch.Generator) -> Tensor:
    """For each point of z (N, d) one at the distance `STEP`, with the same distance in all coordinates that move.

    The slope of a function between the two points is, with the signs of its gradient, the sum of its absolute partial
    derivatives, which is the local Lipschitz constant. The signs are random.

    Args:
        z: points (N, d).
        moves: the coordinates that change, (d,) bool.
        rng: draws the signs.
    """
    step = STEP * moves * (2 * torch.randint(2, z.shape, generator=rng) - 1)
    # Coordinates turn back at the edge of the cube.
    return torch.where((z + step).abs() <= 1, z + step, z - step)


def lipschitz_constant(sample: np.ndarray, confidence: float) -> Lipschitz:
    """The Lipschitz constant, by the method of G. R. Wood and B. P. Zhang, J. Glob. Optim. 8, 1996.

    The maxima of batches of independent slopes have approximately a reverse Weibull distribution, whose end is the
    constant. It is fitted by maximum likelihood, and the interval is that of the profile likelihood. Both are
    asymptotic, for large batches; nothing is proved.

    Args:
        sample: independent slopes (N,), at least twice `BATCHES` of them.
        confidence: the approximate level of the upper end, in (0.5, 1).
    """
    maxima = sample[: len(sample) // BATCHES * BATCHES].reshape(BATCHES, -1).max(1)
    largest, spread = float(sample.max()), float(maxima.std())
    if spread <= 1e-9 * largest:  # all slopes are the same, up to rounding
        return Lipschitz(largest, largest, largest)
    ends = maxima.max() + spread * GAPS
    likelihood = np.array([_log_likelihood(end - maxima) for end in ends])
    # The square of the normal quantile is that of the chi-square distribution with one degree, at 2 confidence - 1.
    near = np.flatnonzero(likelihood >= likelihood.max() - ndtri(confidence) ** 2 / 2)
    best, last = int(likelihood.argmax()), int(near[-1])
    beyond = len(ends) - 1
    estimate, upper = (None if k == beyond else max(largest, float(ends[k])) for k in (best, last))
    return Lipschitz(largest, estimate, upper)


def _log_likelihood(y: np.ndarray) -> float:
    """The largest log-likelihood of y (N,), all positive, over Weibull distributions with a shape within `SHAPES`."""
    logs = np.log(y)

    def excess(shape: float) -> float:
        """The derivative of the log-likelihood in the shape, up to a factor and a sign; it rises with the shape."""
        weight = np.exp(shape * (logs - logs.max()))
        return float((weight * logs).sum() / weight.sum() - 1 / shape - logs.mean())

    low, high = SHAPES
    inside = excess(low) < 0 < excess(high)
    shape: float = brentq(excess, low, high) if inside else low if excess(low) >= 0 else high  # type: ignore[assignment]
    scale = logs.max() + np.log(np.mean(np.exp(shape * (logs - logs.max())))) / shape  # its logarithm
    return float(len(y) * (np.log(shape) - shape * scale - 1) + (shape - 1) * logs.sum())


def largest_from_mean(mean: float, lipschitz: float, dim: int) -> float:
    """The largest |g| of a function on [-1, 1]^d with this Lipschitz constant and this mean of |g|.

    A function that comes to M somewhere stays above M minus L times the distance. In the worst case this cone stands in
    a corner of the cube. Its mean is L r^(d + 1) / (2^d (d + 1)) with r = M/L where r <= 2, and M - 2 L d / (d + 1)
    where it reaches across the cube.
    """
    if lipschitz == 0:
        return mean
    reach = (mean * (dim + 1) * 2.0**dim / lipschitz) ** (1 / (dim + 1))
    return lipschitz * reach if reach <= 2 else mean + 2 * lipschitz * dim / (dim + 1)
