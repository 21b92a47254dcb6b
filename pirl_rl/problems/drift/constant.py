"""Numbers that a problem computes with, as tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


class Constant:
    """Numbers as a tensor of any dtype and on any device, which is made once for each: a copy to a GPU takes time.

    Args:
        values: the numbers, of any shape.
    """

    def __init__(self, values: np.ndarray | Sequence[float]):
        self._values = torch.tensor(np.asarray(values, dtype=np.float64))
        self._made: dict[tuple[torch.dtype, torch.device], Tensor] = {}

    def like(self, x: Tensor) -> Tensor:
        """The numbers with the dtype and on the device of x."""
        key = (x.dtype, x.device)
        if key not in self._made:
            self._made[key] = self._values.to(x)
        return self._made[key]
