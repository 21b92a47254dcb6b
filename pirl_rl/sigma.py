"""Products with sigma(x, u) (*, n, w), which many problems give as one matrix that is expanded to all states.

One product of two matrices then replaces one small product for each state, and nothing of size (*, n, w) is stored.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

SHAPE_ONLY = {"ones_like", "zeros_like", "full_like", "empty_like", "new_ones", "new_zeros", "new_full", "new_empty"}
"""Operations that read the shape, the dtype and the device of a tensor, but none of its entries."""


def constant_matrix(diffusion: Callable[[Tensor, Tensor], Tensor], x: Tensor, u: Tensor) -> Tensor | None:
    """sigma (n, w) of a diffusion that computes with no entry of x and u; None if it does, or cannot be traced.

    The operations that it calls are recorded, so that a sigma that is constant at most states only is not mistaken.

    Args:
        diffusion: maps states (N, n) and controls (N, m) to sigma (N, n, w).
        x: some states (N, n).
        u: as many controls (N, m).
    """
    from torch.fx.experimental.proxy_tensor import make_fx  # takes a second, which not every command needs

    def recorded(x: Tensor, u: Tensor) -> Tensor:
        return diffusion(x, u)

    try:
        # Made functional, a write into a part of a tensor is a dependence like any other.
        graph = make_fx(torch.func.functionalize(recorded))(x, u).graph
    except Exception:  # branches on entries of a tensor and conversions to numpy cannot be recorded
        return None
    reads = {node for node in graph.nodes if node.op == "placeholder"}
    for node in graph.nodes:
        if reads & {*node.all_input_nodes} and getattr(node.target, "__name__", "").split(".")[0] not in SHAPE_ONLY:
            reads.add(node)
            if node.op == "output":
                return None
    sigma = diffusion(x, u)
    # A detour through numpy is not recorded.
    return sigma[0].detach().clone() if bool((sigma == sigma[:1]).all()) else None


def times(sigma: Tensor, z: Tensor) -> Tensor:
    """sigma z (N, n) of sigma (N, n, w) and z (N, w), or (k, N, n) of k of them, z (k, N, w)."""
    if _is_one_matrix(sigma):
        return (_one_matrix(sigma) @ z.mT).mT
    if z.ndim > 2:
        # One product of matrices for each state serves all z, and no (k, N, n, w) products of entries is stored.
        return torch.einsum("nij,knj->kni", sigma, z)
    return (sigma * z.unsqueeze(-2)).sum(-1)


def transposed_times(sigma: Tensor, a: Tensor) -> Tensor:
    """sigma^T a (N, w) of sigma (N, n, w) and a (N, n)."""
    if _is_one_matrix(sigma):
        return a @ _one_matrix(sigma)
    return (sigma * a.unsqueeze(-1)).sum(-2)


def _is_one_matrix(sigma: Tensor) -> bool:
    return sigma.numel() > 0 and all(stride == 0 for stride in sigma.stride()[:-2])


def _one_matrix(sigma: Tensor) -> Tensor:
    return sigma[(0,) * (sigma.ndim - 2)]
