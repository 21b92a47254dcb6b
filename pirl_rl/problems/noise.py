"""Constant noise of independent coordinates, the diffusion of several problems."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from pirl_rl.constants import constant


def independent_noise(x: Tensor, strengths: Sequence[float]) -> Tensor:
    """sigma (*, n, w) at states (*, n): each coordinate whose strength is not 0 has a noise channel of its own.

    Without any noise there is one channel that acts on nothing.

    Args:
        x: states (*, n), which give the shape, the dtype and the device.
        strengths: n numbers, in units of the coordinate per sqrt(s).
    """
    channels = [axis for axis, strength in enumerate(strengths) if strength] or [0]
    rows = [[strength * (axis == channel) for channel in channels] for axis, strength in enumerate(strengths)]
    columns = constant(rows, x)
    return columns.expand(*x.shape[:-1], *columns.shape)
