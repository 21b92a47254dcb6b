"""States at which W meets conditions, with the matrices of its derivatives, and the generator there."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.mesh import Mesh
from pirl_rl.proofs.spline import design


class Points:
    """States with the matrices that give W and its derivatives there from its coefficients at one time to go.

    Args:
        problem: the physics.
        mesh: the mesh of W, with n axes in space.
        x: the states (N, n).

    Attributes:
        values: the matrix of W.
        derivatives: the matrices of its n slopes, and then of its curvatures along the pairs of axes i <= j.
    """

    def __init__(self, problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray):
        self.problem, self.x = problem, x
        axes = range(len(mesh.space))
        self._pairs = [(i, j) for i in axes for j in axes if i <= j]
        self.values = design(mesh.space, x)
        self.derivatives = [design(mesh.space, x, along) for along in [*((i,) for i in axes), *self._pairs]]

    def factors(self, u: Tensor) -> np.ndarray:
        """What multiplies each derivative in f . grad + 1/2 Tr(sigma sigma^T hess), at controls u (N, m).

        Returns:
            The drift and the covariances (terms, N), in the order of `derivatives`.
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

    def derive(self, coefficients: np.ndarray) -> np.ndarray:
        """The derivatives (terms, N) of W with these coefficients."""
        return np.stack([matrix @ coefficients for matrix in self.derivatives])

    def operator(self, factors: np.ndarray) -> Any:
        """The sparse matrix of f . grad + 1/2 Tr(sigma sigma^T hess)."""
        result: Any = sp.csr_matrix(self.values.shape)
        for factor, matrix in zip(factors, self.derivatives, strict=True):
            if factor.any():
                result = result + sp.diags(factor) @ matrix
        return result.tocsr()
