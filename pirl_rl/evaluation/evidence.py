"""Evidence: one measurement, from which both numbers and figures come."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Protocol

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pirl_rl.solution import Solution

POINTS = 1_000_003
"""Keeps the seeds of points apart from those of noise; of a larger number torch would see the lowest 32 bits only."""


class Evidence(Protocol):
    """What was measured, as arrays."""

    def numbers(self) -> dict[str, float]: ...

    def figures(self) -> dict[str, Figure]:
        """Drawn from the same arrays, by name."""
        ...


class Measurement(ABC):
    """An evaluator that keeps the evidence of its last call, to be drawn after it."""

    evidence: Evidence | None = None

    @abstractmethod
    def measure(self, solution: Solution) -> Evidence: ...

    def __call__(self, solution: Solution) -> dict[str, float]:
        self.evidence = self.measure(solution)
        return self.evidence.numbers()


def draw_evidence(evaluators: Iterable[object]) -> dict[str, Figure]:
    """The figures of all evaluators that have measured something to draw."""
    figures: dict[str, Figure] = {}
    for evaluator in evaluators:
        if isinstance(evaluator, Measurement) and evaluator.evidence is not None:
            figures |= evaluator.evidence.figures()
    return figures


def like(solution: Solution, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Tensors in a solution's dtype, on its device."""
    return tuple(tensor.to(solution.device, solution.dtype) for tensor in tensors)


def points_rng(seed: int) -> torch.Generator:
    """A source of points and starts, on the CPU, independent of the noise of the same seed: were both drawn from one
    stream, a path's noise would follow from its start."""
    return torch.Generator().manual_seed(POINTS + seed)


def rng_like(solution: Solution, seed: int) -> torch.Generator:
    """A source of noise on the solution's device."""
    return torch.Generator(solution.device).manual_seed(seed)
