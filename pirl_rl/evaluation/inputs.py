"""Inputs of evaluators: tensors in the solution's dtype and on its device, and seeded random generators."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.solution import Solution

POINTS = 1_000_003
"""An offset that separates the seeds of points from those of noise. It is small, because torch uses the lowest 32 bits
of a seed only."""


def like(solution: Solution, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Convert tensors to the dtype and the device of a solution."""
    return tuple(tensor.to(solution.device, solution.dtype) for tensor in tensors)


def points_rng(seed: int) -> torch.Generator:
    """A random generator for points and starts, on the CPU.

    It is independent of the noise of the same seed. If both came from one stream, a path's noise would be correlated
    with its start.
    """
    return torch.Generator().manual_seed(POINTS + seed)


def noise_rng(solution: Solution, seed: int) -> torch.Generator:
    """A random generator for the noise of paths, on the solution's device."""
    return torch.Generator(solution.device).manual_seed(seed)
