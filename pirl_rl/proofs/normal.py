"""The normal equations of sparse least squares, by Cholesky's factors of a band.

With products of splines numbered along one axis after the other, the band is narrow beside the number of unknowns:
with m splines along each of n axes it has about 3 m^(n - 1) diagonals below the main one. A general sparse solver fills
most of this band too, and takes more time and memory to do so.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from pirl_rl.errors import ProofError


class NormalEquations:
    """The least squares |rows c - right|^2 for many right sides.

    Args:
        rows: the sparse matrix (equations, N).

    Raises:
        ProofError: the matrix has not full rank.
    """

    def __init__(self, rows: Any):
        self._rows = rows
        lower: Any = sp.tril(rows.T @ rows).tocoo()
        below = lower.row - lower.col
        band = np.zeros((below.max() + 1, lower.shape[0]))
        band[below, lower.col] = lower.data
        try:
            self._factors = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        except LinAlgError:
            raise ProofError("proof: the mesh does not determine W; choose another number of cells or steps") from None

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The unknowns (N,) for the right sides (equations,)."""
        return cho_solve_banded((self._factors, True), self._rows.T @ right, check_finite=False)
