"""Numbers that a problem computes with, as tensors that are made once.

A tensor that is made from Python's numbers at each call is copied to a GPU each time. That takes longer than to compute
with it, and a recording of kernels cannot contain it, see `pirl_rl.recording`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

MOST = 4_096
"""The largest number of tensors that are kept; more come from numbers that change from call to call."""

_MADE: dict[Any, Tensor] = {}


def constant(values: Sequence[float] | Sequence[Sequence[float]], like: Tensor) -> Tensor:
    """Numbers as a tensor, made once for each dtype and device; it must not be changed in place.

    Args:
        values: the numbers, (n,), or rows of them, (k, n).
        like: a tensor with the dtype and on the device of the result.
    """
    rows = tuple(tuple(row) if isinstance(row, Sequence) else float(row) for row in values)
    key = rows, like.dtype, like.device
    if key in _MADE:
        return _MADE[key]
    if torch.compiler.is_compiling():  # what the compiler traces must change nothing that outlives it
        return torch.tensor(rows, dtype=like.dtype, device=like.device)
    if len(_MADE) >= MOST:
        _MADE.clear()
    # Made within a transformation of `torch.func`, a trace or inference mode, the tensor would be of no use elsewhere.
    with torch._C._DisableFuncTorch(), _disable_current_modes(), torch.inference_mode(False):
        _MADE[key] = torch.tensor(rows, dtype=like.dtype, device=like.device)
    return _MADE[key]
