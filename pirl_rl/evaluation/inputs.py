"""What evaluators give to networks and simulators: tensors of the right kind, and random generators with seeds."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.solution import Solution

POINTS = 1_000_003
"""Keeps the seeds of points apart from those of noise; of a larger number torch would see the lowest 32 bits only."""


def like(solution: Solution, *tensors: Tensor) -> tuple[Tensor, ...]:
    """The tensors in a solution's dtype, on its device."""
    return tuple(tensor.to(solution.device, solution.dtype) for tensor in tensors)


def points_rng(seed: int) -> torch.Generator:
    """A random generator for points and starts, on the CPU, independent of the noise of the same seed: were both drawn
    from one stream, a path's noise would follow from its start."""
    return torch.Generator().manual_seed(POINTS + seed)


def noise_rng(solution: Solution, seed: int) -> torch.Generator:
    """A random generator for the noise of paths, on the solution's device."""
    return torch.Generator(solution.device).manual_seed(seed)
