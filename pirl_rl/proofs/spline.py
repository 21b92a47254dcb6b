"""Tensor products of cubic B-splines.

W(z) = sum_k c_k prod_j B_kj(z_j) is twice continuously differentiable in every coordinate, and on each cell of its mesh
a polynomial of degree 3 in each of them (C. de Boor, A Practical Guide to Splines, 1978).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from pirl_rl.proofs.affine import ROUNDING
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.polynomials import Polynomials

DEGREE = 3


def knots_of(edges: np.ndarray) -> np.ndarray:
    """Knots of splines on cells with the given edges (k + 1,), DEGREE-fold at both ends."""
    return np.concatenate([edges[:1].repeat(DEGREE), edges, edges[-1:].repeat(DEGREE)])


def basis(edges: np.ndarray, points: np.ndarray, derivative: int = 0) -> np.ndarray:
    """The values (P, k + DEGREE) of all splines of one coordinate, or of a derivative, at points (P,)."""
    knots = knots_of(edges)
    splines = BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)
    return (splines.derivative(derivative) if derivative else splines)(points)


def design(edges: Sequence[np.ndarray], x: np.ndarray, derived: Sequence[int] = ()) -> Any:
    """The sparse matrix (P, N) of the values of all N products of splines at points (P, n).

    Args:
        edges: the edges of the cells along each of n axes.
        x: the points.
        derived: the axes along which the products are differentiated, each as often as it is named.
    """
    numbers, values = np.zeros((len(x), 1), int), np.ones((len(x), 1))
    for j, axis in enumerate(edges):
        # The splines that are not 0 at a point are those of its cell.
        cell = np.clip(np.searchsorted(axis, x[:, j], side="right") - 1, 0, len(axis) - 2)
        active = cell[:, None] + np.arange(DEGREE + 1)
        rows = np.take_along_axis(basis(axis, x[:, j], [*derived].count(j)), active, 1)
        size = (len(x), (DEGREE + 1) ** (j + 1))
        numbers = (numbers[:, :, None] * (len(axis) - 1 + DEGREE) + active[:, None, :]).reshape(size)
        values = (values[:, :, None] * rows[:, None, :]).reshape(size)
    width = math.prod(len(axis) - 1 + DEGREE for axis in edges)
    starts = np.arange(0, numbers.size + 1, numbers.shape[1])
    return sp.csr_matrix((values.ravel(), numbers.ravel(), starts), shape=(len(x), width))


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
        return design(self.edges, points) @ self.coefficients.numpy().ravel()

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
