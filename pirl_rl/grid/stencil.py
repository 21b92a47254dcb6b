"""Decomposition of a covariance into whole offsets: D = sum_k lambda_k v_k v_k^T with lambda_k >= 0.

With it the second-order part of the HJB equation is a sum of second differences along the offsets v_k of the mesh, and
the scheme is monotone for every sigma, correlated or not. Selling's formula (E. Selling, Journal fuer die reine und
angewandte Mathematik 77, 1874) gives it in up to three dimensions: b_0, ..., b_n are integer vectors with sum 0, of
which each n are a basis, and if <b_i, D b_j> <= 0 for all i < j, then lambda_ij = -<b_i, D b_j>, and v_ij is
orthogonal to all b_k with k other than i and j. For its use in monotone schemes see J. Fehrenbach and J.-M. Mirebeau,
Journal of Mathematical Imaging and Vision 49, 2014.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

SWEEPS = 200
"""Largest number of steps of the reduction. Their number grows with the logarithm of the condition number of D."""


def decompose(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights and offsets whose sum is the covariance.

    Args:
        covariance: D (P, n, n), positive semidefinite, in units of the mesh: (sigma sigma^T)_ij / (dx_i dx_j).

    Returns:
        Weights (P, k), >= 0, in the units of D, and whole offsets (P, k, n), with k = n (n + 1) / 2.
    """
    size = covariance.shape[-1]
    if size == 1:
        return covariance[:, :, 0], np.ones((len(covariance), 1, 1), int)
    base = _reduced(covariance)
    weights, offsets = [], []
    for i, j in combinations(range(size + 1), 2):
        rest = [base[:, k] for k in range(size + 1) if k not in (i, j)]
        weights.append(np.maximum(-_product(base, covariance, i, j), 0.0))
        offsets.append(np.stack([-rest[0][:, 1], rest[0][:, 0]], -1) if size == 2 else np.cross(rest[0], rest[1]))
    return np.stack(weights, 1), np.stack(offsets, 1)


def bounded(covariance: np.ndarray, least: float) -> np.ndarray:
    """The covariance D (P, n, n) with so much added to its diagonal that its offsets are bounded.

    Noise in one oblique direction alone may need offsets without bound. Hence, where D is not diagonal, its smallest
    eigenvalue is raised to `least` times its trace, on the axes that have noise. The offsets then have at most about
    1 / sqrt(least) nodes, and D changes by at most `least` times its trace.
    """
    diagonal = np.einsum("pii->pi", covariance)
    trace, noisy = diagonal.sum(-1), diagonal > 0
    oblique = (np.abs(covariance).sum((-2, -1)) > trace * (1 + 1e-12))[:, None]
    identity = np.eye(covariance.shape[-1])
    # Axes without noise are given some, so that they do not determine the smallest eigenvalue.
    smallest = np.linalg.eigvalsh(covariance + (trace[:, None] * ~noisy)[:, None] * identity)[:, :1]
    lack = np.maximum(least * trace[:, None] - smallest, 0.0) * (oblique & noisy)
    return covariance + lack[:, None] * identity


def _reduced(covariance: np.ndarray) -> np.ndarray:
    """The integer vectors b (P, n + 1, n) with <b_i, D b_j> <= 0 for all i < j, to rounding."""
    size = covariance.shape[-1]
    start = np.concatenate([np.eye(size, dtype=int), -np.ones((1, size), int)])
    base = np.repeat(start[None], len(covariance), 0)
    rounding = 1e-12 * np.trace(covariance, axis1=-2, axis2=-1)
    for _ in range(SWEEPS):
        changed = False
        for i, j in combinations(range(size + 1), 2):
            acute = _product(base, covariance, i, j) > rounding
            if not acute.any():
                continue
            changed = True
            old = base[acute]
            new = old + old[:, i : i + 1] * (2 if size == 2 else 1)
            new[:, i], new[:, j] = -old[:, i], old[:, j]
            base[acute] = new
        if not changed:
            break
    return base


def _product(base: np.ndarray, covariance: np.ndarray, i: int, j: int) -> np.ndarray:
    return np.einsum("pa,pab,pb->p", base[:, i], covariance, base[:, j])
