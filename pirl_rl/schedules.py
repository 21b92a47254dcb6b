"""Schedules: the weights (w_TD, w_HJB, w_BC) of the critic loss over a run, or over one stage of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from pirl_rl.errors import ArgumentError

Weights = tuple[float, float, float]
WEIGHTS = ("td_weight", "hjb_weight", "boundary_weight")
"""Names of the weights, in this order."""


class Schedule(Protocol):
    """Weights, and how far the transition between their two ends has come.

    Args:
        update: k, counted from 0 at the start of the run or of the stage that the schedule belongs to.
        length: updates of that run or stage.
    """

    def __call__(self, update: int, length: int) -> Weights:
        """(w_TD, w_HJB, w_BC)."""
        ...

    def progress(self, update: int, length: int) -> float:
        """eta in [0, 1]; samplers that move with the schedule, as `ReplayCollocation`, follow it."""
        ...


def check_weights(name: str, values: Sequence[float]) -> Weights:
    """Three finite weights that are not negative.

    Raises:
        ArgumentError: naming the argument.
    """
    numbers = tuple(float(value) for value in values)
    if len(numbers) != 3 or not all(math.isfinite(value) and value >= 0 for value in numbers):
        raise ArgumentError(
            f"schedule.{name}: expected three finite weights >= 0 as [td, hjb, boundary], got {list(values)}"
        )
    return numbers  # type: ignore[return-value]


class _Transition:
    """w_i(k) = w_i^init + (w_i^final - w_i^init) eta(k), Eq. (weight_scheduling)."""

    def __init__(self, initial: Sequence[float], final: Sequence[float]):
        self.initial, self.final = check_weights("initial", initial), check_weights("final", final)

    def progress(self, update: int, length: int) -> float:
        raise NotImplementedError

    def __call__(self, update: int, length: int) -> Weights:
        eta = self.progress(update, length)
        return tuple(a + (b - a) * eta for a, b in zip(self.initial, self.final, strict=True))  # type: ignore[return-value]


class LossSchedule(_Transition):
    """The paper's sigmoid: eta(k) = 1 / (1 + exp(-steepness (k - center))).

    Args:
        initial: (w_TD, w_HJB, w_BC) before the transition.
        final: the same after it.
        center: where the transition is half done: a number above 1 is an update, a number up to 1 is a share of the
            length.
        steepness: alpha > 0, in 1/updates beside a center in updates, in 1/length beside a center that is a share.

    Raises:
        ArgumentError: weights that are no three numbers >= 0, a center that is not finite, a steepness <= 0.
    """

    def __init__(self, initial: Sequence[float], final: Sequence[float], center: float, steepness: float):
        super().__init__(initial, final)
        if not (math.isfinite(center) and math.isfinite(steepness) and steepness > 0):
            raise ArgumentError(f"schedule: expected finite center and steepness > 0, got {center} and {steepness}")
        self.center, self.steepness = float(center), float(steepness)

    def progress(self, update: int, length: int) -> float:
        unit = length if self.center <= 1 else 1
        return (1 + math.tanh(self.steepness / unit * (update - self.center * unit) / 2)) / 2


class LinearSchedule(_Transition):
    """eta rises linearly from 0 at `start` to 1 at `end`.

    Args:
        initial: (w_TD, w_HJB, w_BC) up to the start.
        final: the same from the end on.
        start: an update, or a share of the length where `end` is at most 1.
        end: an update if above 1, else a share of the length.

    Raises:
        ArgumentError: weights that are no three numbers >= 0, an end that is not after the start.
    """

    def __init__(self, initial: Sequence[float], final: Sequence[float], start: float, end: float):
        super().__init__(initial, final)
        if not end > start:
            raise ArgumentError(f"schedule: expected end > start, got start={start}, end={end}")
        self.start, self.end = float(start), float(end)

    def progress(self, update: int, length: int) -> float:
        unit = length if self.end <= 1 else 1
        return min(max((update - self.start * unit) / ((self.end - self.start) * unit), 0.0), 1.0)


class ConstantSchedule(_Transition):
    """The final weights from the first update on.

    Args:
        initial: never in force; a method of `conf/method` sets both ends of whatever schedule is chosen.
        final: (w_TD, w_HJB, w_BC).
    """

    def progress(self, update: int, length: int) -> float:
        return 1.0
