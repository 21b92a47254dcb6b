"""How drifts and diffusions of the problems are put together."""

from __future__ import annotations

import torch
from torch import Tensor


def rows(*entries: Tensor) -> Tensor:
    return torch.stack(entries, -1)


def constant(x: Tensor, *matrix: list[float]) -> Tensor:
    """The same matrix (n, w) at all states (*, n)."""
    sigma = x.new_tensor(matrix)
    return sigma.expand(*x.shape[:-1], *sigma.shape)
