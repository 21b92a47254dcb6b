"""Tensor products of cubic B-splines, and their polynomials on boxes.

W(z) = sum_k c_k prod_j B_kj(z_j) is twice continuously differentiable in every coordinate, and on each cell of its mesh
a polynomial of degree 3 in each of them (C. de Boor, A Practical Guide to Splines, 1978).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from pirl_rl.proofs.affine import ROUNDING, Affine
from pirl_rl.proofs.boxes import Boxes

DEGREE = 3


def knots_of(edges: np.ndarray) -> np.ndarray:
    """Knots of splines on cells with the given edges (k + 1,), DEGREE-fold at both ends."""
    return np.concatenate([edges[:1].repeat(DEGREE), edges, edges[-1:].repeat(DEGREE)])


def nodes_of(edges: np.ndarray) -> np.ndarray:
    """The points (k + DEGREE,), one for each spline, at which conditions are imposed: means of inner knots."""
    knots = knots_of(edges)
    return np.array([knots[i + 1 : i + 1 + DEGREE].mean() for i in range(len(knots) - DEGREE - 1)])


def basis(edges: np.ndarray, points: np.ndarray, derivative: int = 0) -> np.ndarray:
    """The values (P, k + DEGREE) of all splines, or of a derivative, at points (P,)."""
    knots = knots_of(edges)
    splines = BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)
    return (splines.derivative(derivative) if derivative else splines)(points)


class Polynomials:
    """Polynomials (N, 4, ..., 4) in the coordinates e in [-1, 1]^d of N boxes, by powers of each coordinate.

    Args:
        powers: the coefficients.
        half_width: halves (N, d) of the boxes' sides, by which derivatives are divided.
        rounding: bounds (N,) of the errors of each coefficient.
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
        return Polynomials(moved / width, self.half_width, len(order) * self.rounding / self.half_width[:, axis])

    def enclosure(self) -> Affine:
        """The polynomials as affine forms (N,): what is not linear is bounded by the sum of its coefficients."""
        dim = self.powers.ndim - 1
        flat = self.powers.flatten(1)
        zero = [slice(None), *[0] * dim]
        units = []
        for axis in range(dim):
            index = list(zero)
            index[axis + 1] = 1
            constant = self.powers.shape[axis + 1] == 1
            units.append(torch.zeros_like(flat[:, 0]) if constant else self.powers[tuple(index)])
        centre, slopes = self.powers[tuple(zero)], torch.stack(units)
        total = flat.abs().sum(-1)
        rest = (total - centre.abs() - slopes.abs().sum(0)).clamp(min=0)
        return Affine(centre, slopes, rest + flat.shape[-1] * (self.rounding + ROUNDING * total))


class Spline:
    """A tensor product of cubic splines.

    Args:
        edges: the edges of the cells along each of d axes, ascending.
        coefficients: (k_1 + DEGREE, ..., k_d + DEGREE).
    """

    def __init__(self, edges: Sequence[np.ndarray], coefficients: np.ndarray):
        self.edges, self.coefficients = [*edges], torch.as_tensor(coefficients, dtype=torch.float64)
        self._cells = [_cell_polynomials(axis) for axis in edges]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """W (P,) at points (P, d)."""
        result = self.coefficients.numpy()
        rows = [basis(axis, points[:, j]) for j, axis in enumerate(self.edges)]
        result = np.tensordot(rows[0], result, 1)
        for row in rows[1:]:
            result = np.einsum("pk,pk...->p...", row, result)
        return result

    def on(self, boxes: Boxes) -> Polynomials:
        """The polynomials on boxes, each within one cell."""
        n, dim = len(boxes), len(self.edges)
        active = torch.arange(DEGREE + 1)
        index = [
            (boxes.cell[:, j, None] + active).reshape(n, *[DEGREE + 1 if i == j else 1 for i in range(dim)])
            for j in range(dim)
        ]
        local = self.coefficients[tuple(index)]
        size = local.abs().flatten(1).amax(-1)
        for j in range(dim):
            matrix = _shifted(self._cells[j][boxes.cell[:, j]], boxes.place[:, j], boxes.share[:, j])
            # Each step replaces the first axis of coefficients by powers, which become the last axis.
            local = torch.einsum("nap,na...->n...p", matrix, local)
            size = size * matrix.abs().sum(1).amax(-1)
        return Polynomials(local, boxes.half_width, 64 * dim * ROUNDING * size)


def _cell_polynomials(edges: np.ndarray) -> Tensor:
    """Polynomials (cells, active, powers) of the splines that are not 0 on each cell, in coordinates s in [-1, 1]."""
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    orders = [
        basis(edges, middle, order) * (half**order / math.factorial(order))[:, None] for order in range(DEGREE + 1)
    ]
    cells = np.arange(len(middle))[:, None] + np.arange(DEGREE + 1)
    return torch.from_numpy(np.stack([np.take_along_axis(values, cells, 1) for values in orders], -1))


def _shifted(polynomials: Tensor, place: Tensor, share: Tensor) -> Tensor:
    """Polynomials (N, active, powers) in e, where s = place + share e, from those in s."""
    powers = polynomials.shape[-1]
    shift = polynomials.new_zeros(len(polynomials), powers, powers)
    for old in range(powers):
        for new in range(old + 1):
            shift[:, old, new] = math.comb(old, new) * place ** (old - new) * share**new
    return polynomials @ shift
