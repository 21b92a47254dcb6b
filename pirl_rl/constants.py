"""Numbers that a problem computes with, as tensors that are made once.

A tensor that is made from Python's numbers at each call is copied to a GPU each time. That takes longer than to compute
with it, and a recording of kernels cannot contain it, see `pirl_rl.recording`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

MOST = 4_096
"""The largest number of arrays that `constant` keeps; more come from numbers that change from call to call."""

_KEPT: dict[Any, Constant] = {}


class Constant:
    """Numbers as a tensor of any dtype and on any device, which is made once for each.

    Args:
        values: the numbers, of any shape.
    """

    def __init__(self, values: Any):
        self._values = torch.tensor(np.asarray(values, dtype=np.float64))
        self._made: dict[tuple[torch.dtype, torch.device], Tensor] = {}

    def like(self, x: Tensor) -> Tensor:
        """The numbers with the dtype and on the device of x; the tensor must not be changed in place."""
        key = (x.dtype, x.device)
        if key in self._made:
            return self._made[key]
        if torch.compiler.is_compiling():  # what the compiler traces must change nothing that outlives it
            return self._values.to(dtype=x.dtype, device=x.device)
        # Made within a transformation of `torch.func`, a trace or inference mode, the tensor would be of no use
        # elsewhere.
        with torch._C._DisableFuncTorch(), _disable_current_modes(), torch.inference_mode(False):
            self._made[key] = self._values.to(dtype=x.dtype, device=x.device)
        return self._made[key]


def constant(values: float | Sequence[float] | Sequence[Sequence[float]] | np.ndarray, like: Tensor) -> Tensor:
    """Numbers as a tensor, made once for each dtype and device; it must not be changed in place.

    Args:
        values: one number, several (n,), or rows of them (k, n).
        like: a tensor with the dtype and on the device of the result.
    """
    numbers = values.tolist() if isinstance(values, np.ndarray) else values
    rows: Any = numbers
    if not isinstance(numbers, (int, float)):
        rows = tuple(tuple(row) if isinstance(row, Sequence) else float(row) for row in numbers)
    if rows in _KEPT:
        return _KEPT[rows].like(like)
    if torch.compiler.is_compiling():
        return torch.tensor(rows, dtype=like.dtype, device=like.device)
    if len(_KEPT) >= MOST:
        _KEPT.clear()
    with torch._C._DisableFuncTorch(), _disable_current_modes(), torch.inference_mode(False):
        _KEPT[rows] = Constant(rows)
    return _KEPT[rows].like(like)
