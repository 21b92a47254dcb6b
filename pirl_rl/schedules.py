"""Schedules: the weights (w_TD, w_HJB, w_BC) of Eq. (critic_loss) as functions of the update, over a run or a stage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from pirl_rl.errors import ArgumentError

Weights = tuple[float, float, float]
WEIGHTS = ("td_weight", "hjb_weight", "boundary_weight")
"""Names of the weights in the loss and in the metrics, in the order of `Weights`."""


class Schedule(Protocol):
    """Gives the weights of the critic loss at an update.

    In both methods, `update` is counted from 0 at the start of the run, or of the stage to which the schedule belongs,
    and `length` is the number of updates of that run or stage.
    """

    def __call__(self, update: int, length: int) -> Weights:
        """The weights (w_TD, w_HJB, w_BC)."""
        ...

    def progress(self, update: int, length: int) -> float:
        """The progress eta, in [0, 1], from the initial to the final weights; `ReplayCollocation` follows it too."""
        ...


def check_weights(name: str, values: Sequence[float]) -> Weights:
    """The weights, as three floats.

    Raises:
        ArgumentError: they are not three finite numbers >= 0; the message names `name`.
    """
    numbers = tuple(float(value) for value in values)
    if len(numbers) != 3 or not all(math.isfinite(value) and value >= 0 for value in numbers):
        raise ArgumentError(
            f"schedule.{name}: expected three finite weights >= 0 as [td, hjb, boundary], got {list(values)}"
        )
    return numbers  # type: ignore[return-value]


class _Transition:
    """w_i(k) = w_i^init + (w_i^final - w_i^init) eta(k), Eq. (weight_scheduling), with eta from a subclass."""

    def __init__(self, initial: Sequence[float], final: Sequence[float]):
        self.initial, self.final = check_weights("initial", initial), check_weights("final", final)

    def progress(self, update: int, length: int) -> float:
        raise NotImplementedError

    def __call__(self, update: int, length: int) -> Weights:
        eta = self.progress(update, length)
        return tuple(a + (b - a) * eta for a, b in zip(self.initial, self.final, strict=True))  # type: ignore[return-value]


class LossSchedule(_Transition):
    """The sigmoid of the paper: eta(k) = 1 / (1 + exp(-steepness (k - center))), Eq. (weight_scheduling).

    Args:
        initial: (w_TD, w_HJB, w_BC) before the transition.
        final: (w_TD, w_HJB, w_BC) after the transition.
        center: where eta = 1/2. A number above 1 is an update; a number up to 1 is a share of the length of the run or
            stage.
        steepness: alpha > 0, in 1/updates if the center is an update, in 1/length if the center is a share.

    Raises:
        ArgumentError: the weights are not three finite numbers >= 0, `center` is not finite, or `steepness` is not
            positive and finite.
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
    """A linear transition: eta rises from 0 at `start` to 1 at `end`.

    Args:
        initial: (w_TD, w_HJB, w_BC) until `start`.
        final: (w_TD, w_HJB, w_BC) from `end` on.
        start: an update, or a share of the length of the run or stage if `end` is one.
        end: a number above 1 is an update; a number up to 1 is a share of the length of the run or stage.

    Raises:
        ArgumentError: the weights are not three finite numbers >= 0, or `end` is not above `start`.
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
    """The final weights at all updates: eta = 1.

    Args:
        initial: checked but not used; it is an argument because the methods in `conf/method` set `initial` and `final`
            of every schedule.
        final: (w_TD, w_HJB, w_BC) at all updates.

    Raises:
        ArgumentError: the weights are not three finite numbers >= 0.
    """

    def progress(self, update: int, length: int) -> float:
        return 1.0
