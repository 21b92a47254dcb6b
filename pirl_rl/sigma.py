"""Products with sigma(x, u) (*, n, w), which many problems give as one matrix that is expanded to all states.

One product of two matrices then replaces one small product for each state, and nothing of size (*, n, w) is stored.
"""

from __future__ import annotations

from torch import Tensor


def times(sigma: Tensor, z: Tensor) -> Tensor:
    """sigma z (N, n) of sigma (N, n, w) and z (N, w)."""
    if _is_one_matrix(sigma):
        return (_one_matrix(sigma) @ z.mT).mT
    return (sigma * z.unsqueeze(-2)).sum(-1)


def transposed_times(sigma: Tensor, a: Tensor) -> Tensor:
    """sigma^T a (N, w) of sigma (N, n, w) and a (N, n)."""
    if _is_one_matrix(sigma):
        return a @ _one_matrix(sigma)
    return (sigma * a.unsqueeze(-1)).sum(-2)


def _is_one_matrix(sigma: Tensor) -> bool:
    return all(stride == 0 for stride in sigma.stride()[:-2])


def _one_matrix(sigma: Tensor) -> Tensor:
    return sigma[(0,) * (sigma.ndim - 2)]
