"""A problem of one's own: a ferry reaches its pier before wind and waves drive it onto the rocks."""

import torch
from torch import Tensor

from pirl_rl import Box, ReachAvoidProblem


class Ferry(ReachAvoidProblem):
    """dX = (U + wind) dt + 0.5 dW in m: reach the pier at x >= 1 before the rocks at x <= -1, within 2 s.

    Args:
        wind: the drift of the wind, m/s.
    """

    horizon = 2.0
    states, controls = Box([-1.0], [1.0]), Box([-1.0], [1.0])

    def __init__(self, wind: float = -0.5):
        super().__init__()
        self.wind = wind

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        """(*, 1), (*, 1) -> (*, 1)."""
        return u + self.wind

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        """(*, 1), (*, 1) -> (*, 1, 1): one column for each noise channel."""
        return torch.full_like(x, 0.5).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        """(*, 1) -> (*): <= 0 at the pier."""
        return 1.0 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        """(*, 1) -> (*): <= 0 on the rocks."""
        return 1.0 + x[..., 0]
