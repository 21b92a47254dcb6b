"""States at which W meets conditions, with the matrices of its derivatives, and the generator there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.mesh import Mesh, product
from pirl_rl.proofs.spline import basis, design


class States:
    """States, with the factors of the derivatives of W there.

    The derivatives are the n slopes, and then the curvatures along pairs of axes i <= j.

    Args:
        problem: the physics.
        x: the states (N, n).
    """

    def __init__(self, problem: ReachAvoidProblem, x: np.ndarray):
        self.problem, self.x = problem, x
        axes = range(x.shape[1])
        self._pairs = [(i, j) for i in axes for j in axes if i <= j]
        self._along = [*((i,) for i in axes), *self._pairs]

    def factors(self, u: Tensor) -> np.ndarray:
        """What multiplies each derivative in f . grad + 1/2 Tr(sigma sigma^T hess), at controls u (N, m).

        Returns:
            The drift and the covariances (terms, N), in the order of the derivatives.
        """
        x = torch.from_numpy(self.x)
        f, sigma = self.problem.drift(x, u), self.problem.diffusion(x, u)
        a = sigma @ sigma.mT
        curved = [a[:, i, j] * (0.5 if i == j else 1.0) for i, j in self._pairs]
        return torch.stack([*f.unbind(-1), *curved]).numpy()

    def crossed(self, factors: np.ndarray, normals: np.ndarray, least: np.ndarray) -> np.ndarray:
        """Whether paths move along directions at the states, by noise or by the drift, (N,) bool.

        Args:
            factors: the drift and the covariances (terms, N).
            normals: the directions (N, n), of any length.
            least: the width (N,) that the layer must have in which noise works against the drift, in these lengths.
        """
        n = self.x.shape[1]
        drift, variance = np.einsum("in,ni->n", factors[:n], normals), np.zeros(len(normals))
        for factor, (i, j) in zip(factors[n:], self._pairs, strict=True):
            variance += 2 * factor * normals[:, i] * normals[:, j]
        return (drift >= 0) | (variance > 2 * least * np.abs(drift))


class Points(States):
    """States with the matrices that give W and its derivatives there from its coefficients at one time to go.

    Args:
        problem: the physics.
        mesh: the mesh of W, with n axes in space.
        x: the states (N, n).

    Attributes:
        values: the matrix of W.
    """

    def __init__(self, problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray):
        super().__init__(problem, x)
        self.values = design(mesh.space, x)
        self._derivatives = [design(mesh.space, x, along) for along in self._along]

    def operator(self, factors: np.ndarray) -> Any:
        """The sparse matrix of f . grad + 1/2 Tr(sigma sigma^T hess)."""
        result: Any = sp.csr_matrix(self.values.shape)
        for factor, matrix in zip(factors, self._derivatives, strict=True):
            if factor.any():
                result = result + sp.diags(factor) @ matrix
        return result.tocsr()


class Lattice(States):
    """States with coordinates out of a few along each axis, where W is a product of small matrices, one for each axis.

    Matrices for all states at once, as those of `Points`, have (DEGREE + 1)^n entries for each state.

    Args:
        problem: the physics.
        mesh: the mesh of W, with n axes in space.
        axes: the coordinates along each axis.
        chosen: which of all states with these coordinates are meant, (P,) bool in the order of `product`.
    """

    def __init__(self, problem: ReachAvoidProblem, mesh: Mesh, axes: Sequence[np.ndarray], chosen: np.ndarray):
        super().__init__(problem, product(axes)[chosen])
        self._chosen, self._shape = chosen, mesh.shape
        self._bases = [
            [basis(edges, points, order) for order in range(3)] for edges, points in zip(mesh.space, axes, strict=True)
        ]

    def value(self, coefficients: np.ndarray, along: Sequence[int] = ()) -> np.ndarray:
        """W (N,) with these coefficients, or its derivative along axes."""
        result = coefficients.reshape(self._shape)
        for axis, bases in enumerate(self._bases):
            # Each step replaces the first axis of coefficients by states, which become the last axis.
            result = np.tensordot(result, bases[[*along].count(axis)], (0, 1))
        return result.ravel()[self._chosen]

    def derive(self, coefficients: np.ndarray) -> np.ndarray:
        """The derivatives (terms, N) of W with these coefficients."""
        return np.stack([self.value(coefficients, along) for along in self._along])
