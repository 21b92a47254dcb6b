"""Schedules: the weights (w_TD, w_HJB, w_BC) of the critic loss as functions of the update k."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from pirl_rl.errors import ArgumentError

Weights = tuple[float, float, float]


class Schedule(Protocol):
    """k -> (w_TD, w_HJB, w_BC), and how far the transition between its ends has come, in [0, 1]."""

    def __call__(self, update: float) -> Weights: ...

    def progress(self, update: float) -> float: ...


def _weights(name: str, values: Sequence[float]) -> Weights:
    numbers = tuple(float(value) for value in values)
    if len(numbers) != 3 or not all(math.isfinite(value) and value >= 0 for value in numbers):
        raise ArgumentError(
            f"schedule.{name}: expected three finite weights >= 0 as [td, hjb, boundary], got {list(values)}"
        )
    return numbers  # type: ignore[return-value]


class _Transition:
    """w_i(k) = w_i^init + (w_i^final - w_i^init) eta(k), Eq. (weight_scheduling)."""

    def __init__(self, initial: Sequence[float], final: Sequence[float]):
        self.initial, self.final = _weights("initial", initial), _weights("final", final)

    def progress(self, update: float) -> float:
        raise NotImplementedError

    def __call__(self, update: float) -> Weights:
        eta = self.progress(update)
        return tuple(a + (b - a) * eta for a, b in zip(self.initial, self.final, strict=True))  # type: ignore[return-value]


class LossSchedule(_Transition):
    """The paper's sigmoid: eta(k) = 1 / (1 + exp(-steepness (k - center))).

    Args:
        initial: (w_TD, w_HJB, w_BC) before the transition.
        final: the same after it.
        center: the update at which the transition is half done.
        steepness: alpha, 1/updates; positive.
    """

    def __init__(self, initial: Sequence[float], final: Sequence[float], center: float, steepness: float):
        super().__init__(initial, final)
        if not (math.isfinite(center) and math.isfinite(steepness) and steepness > 0):
            raise ArgumentError(f"schedule: expected finite center and steepness > 0, got {center} and {steepness}")
        self.center, self.steepness = float(center), float(steepness)

    def progress(self, update: float) -> float:
        return (1 + math.tanh(self.steepness * (update - self.center) / 2)) / 2


class LinearSchedule(_Transition):
    """eta rises linearly from 0 at the update `start` to 1 at `end`."""

    def __init__(self, initial: Sequence[float], final: Sequence[float], start: float, end: float):
        super().__init__(initial, final)
        if not end > start:
            raise ArgumentError(f"schedule: expected end > start, got start={start}, end={end}")
        self.start, self.end = float(start), float(end)

    def progress(self, update: float) -> float:
        return min(max((update - self.start) / (self.end - self.start), 0.0), 1.0)


class ConstantSchedule(_Transition):
    """The final weights from the first update on; `initial` is there because a method sets both."""

    def progress(self, update: float) -> float:
        return 1.0
