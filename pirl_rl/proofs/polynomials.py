"""Polynomials on boxes, and Taylor models: polynomials with a bound of what they leave out.

The terms of L^pi W are large and cancel. Added as affine forms they would keep the bounds of their nonlinear parts,
which do not cancel. As polynomials they do (K. Makino and M. Berz, Int. J. Pure Appl. Math. 4, 2003).
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import cache

import torch
from torch import Tensor

from pirl_rl.proofs.affine import ROUNDING, Affine


class Polynomials:
    """Polynomials (N, p_1, ..., p_d) in the coordinates e in [-1, 1]^d of N boxes, by powers of each coordinate.

    Args:
        powers: the coefficients.
        half_width: halves (N, d) of the boxes' sides, by which derivatives are divided.
        rounding: bounds (N,) of the error of each coefficient.
    """

    def __init__(self, powers: Tensor, half_width: Tensor, rounding: Tensor):
        self.powers, self.half_width, self.rounding = powers, half_width, rounding

    def at(self, index: Tensor) -> Polynomials:
        """The polynomials of some of the boxes."""
        return Polynomials(self.powers[index], self.half_width[index], self.rounding[index])

    def derivative(self, axis: int) -> Polynomials:
        """The derivative in a coordinate of the box's own space, per unit."""
        place = axis + 1
        order = torch.arange(1, self.powers.shape[place], dtype=torch.float64)
        shape = [1] * self.powers.ndim
        shape[place] = -1
        moved = self.powers.narrow(place, 1, len(order)) * order.reshape(shape)
        width = self.half_width[:, axis].reshape(-1, *[1] * (self.powers.ndim - 1))
        rounding = 2 * len(order) * self.rounding / self.half_width[:, axis]
        return Polynomials(moved / width, self.half_width, rounding)

    def model(self) -> TaylorModel:
        """The polynomials as Taylor models, whose remainder is that of rounding."""
        return TaylorModel(self.powers, self.powers[0].numel() * self.rounding)


class TaylorModel:
    """Functions on N boxes: polynomials (N, p_1, ..., p_d) in e in [-1, 1]^d, wrong by at most a remainder (N,)."""

    def __init__(self, powers: Tensor, remainder: Tensor):
        self.powers, self.remainder = powers, remainder

    @property
    def size(self) -> Tensor:
        """A bound (N,) of the absolute value."""
        return self.powers.flatten(1).abs().sum(-1) + self.remainder

    def __add__(self, other: TaylorModel) -> TaylorModel:
        shape = [max(pair) for pair in zip(self.powers.shape[1:], other.powers.shape[1:], strict=True)]
        powers = _grown(self.powers, shape) + _grown(other.powers, shape)
        return TaylorModel(powers, self.remainder + other.remainder + 2 * ROUNDING * (self.size + other.size))

    def __neg__(self) -> TaylorModel:
        return TaylorModel(-self.powers, self.remainder)

    def __mul__(self, factor: Affine) -> TaylorModel:
        """The product with affine forms (N,) of the boxes, whose radius enters the remainder."""
        shape = list(self.powers.shape[1:])
        result = _grown(self.powers * _column(factor.centre, self.powers), [length + 1 for length in shape])
        for axis, slopes in enumerate(factor.slopes):
            if not bool(slopes.any()):
                continue
            part = result
            for j, length in enumerate(shape):
                part = part.narrow(j + 1, int(j == axis), length)
            part += self.powers * _column(slopes, self.powers)
        # Each of at most d + 1 products that meet in a coefficient is rounded, and so are their sums.
        rounding = 4 * (len(factor.slopes) + 1) * ROUNDING * factor.magnitude * self.size
        return TaylorModel(result, factor.radius * self.size + factor.magnitude * self.remainder + rounding)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """A lower and an upper bound (N,): the least and the largest Bernstein coefficient, and the remainder."""
        values, lengths = self.powers, self.powers.shape[1:]
        for length in lengths:
            # Each step replaces the first axis of powers by Bernstein coefficients, which become the last axis.
            values = values.movedim(1, -1) @ _to_bernstein(length)
        low, high = values.flatten(1).aminmax(dim=-1)
        # No entry of the matrices is above 1, so that no sum on the way is larger than the size.
        reach = self.remainder + 2 * sum(length + 4 for length in lengths) * ROUNDING * self.size
        return low - reach, high + reach

    def minus_absolute(self) -> tuple[TaylorModel, Tensor]:
        """A lower bound of -|g| for these functions g, and whether g may change its sign (N,).

        Where it does, |g| lies below its chord between both bounds of g.
        """
        low, high = self.bounds()
        width = (high - low).clamp(min=torch.finfo(torch.float64).tiny)
        slope = ((high.abs() - low.abs()) / width).clamp(-1, 1)
        # |g| is convex, so that a line above it at both bounds is above it between them.
        offset = torch.maximum(low.abs() - slope * low, high.abs() - slope * high).clamp(min=0)
        rounding = 8 * ROUNDING * (self.size + low.abs() + high.abs())
        powers = -self.powers * _column(slope, self.powers)
        powers.flatten(1)[:, 0] -= offset
        return TaylorModel(powers, self.remainder * slope.abs() + rounding), (low < 0) & (high > 0)

    def variation(self) -> Tensor:
        """A measure (d, N) of how much the polynomial changes along each coordinate."""
        size, rows = self.powers.abs(), []
        for axis in range(size.ndim - 1):
            order = torch.arange(size.shape[axis + 1], dtype=torch.float64)
            weight = order.reshape([-1 if j == axis else 1 for j in range(size.ndim - 1)])
            rows.append((size * weight).flatten(1).sum(-1))
        return torch.stack(rows)


@cache
def _to_bernstein(length: int) -> Tensor:
    """The matrix (powers, coefficients) from powers of e in [-1, 1] to Bernstein's polynomials on this interval.

    A polynomial is a mean of its Bernstein coefficients with weights that depend on e, so that it lies between the
    least and the largest of them (R. T. Farouki, Comput. Aided Geom. Des. 29, 2012).
    """
    degree = length - 1

    def entry(power: int, number: int) -> float:
        # With t = (1 + e) / 2, e^m = (2 t - 1)^m, and the coefficients of t^k are C(i, k) / C(degree, k).
        parts = (
            Fraction(math.comb(power, k) * 2**k * (-1) ** (power - k) * math.comb(number, k), math.comb(degree, k))
            for k in range(power + 1)
        )
        return float(sum(parts))

    return torch.tensor([[entry(m, i) for i in range(length)] for m in range(length)], dtype=torch.float64)


def _grown(powers: Tensor, shape: list[int]) -> Tensor:
    """Coefficients with zeros for higher powers."""
    missing = [new - old for new, old in zip(shape, powers.shape[1:], strict=True)]
    return torch.nn.functional.pad(powers, [size for extra in reversed(missing) for size in (0, extra)])


def _column(value: Tensor, powers: Tensor) -> Tensor:
    """Numbers (N,), or one for all boxes, that broadcast with coefficients (N, p_1, ..., p_d)."""
    return value.reshape(-1, *[1] * (powers.ndim - 1))
