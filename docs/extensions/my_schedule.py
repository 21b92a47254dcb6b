"""A schedule of one's own: all weights change at once."""

from collections.abc import Sequence

from pirl_rl.errors import ArgumentError
from pirl_rl.schedules import Weights


class Step:
    """The initial weights up to a share of the run, or of the stage, and the final ones from there on.

    Args:
        initial: (w_TD, w_HJB, w_BC) before the step.
        final: the same after it.
        at: where the step lies, as a share of the length, from 0 to 1.

    Raises:
        ArgumentError: a share that is not from 0 to 1.
    """

    def __init__(self, initial: Sequence[float], final: Sequence[float], at: float = 0.5):
        if not 0 <= at <= 1:
            raise ArgumentError(f"schedule.at: expected a share from 0 to 1, got {at}")
        self.initial, self.final, self.at = tuple(initial), tuple(final), at

    def progress(self, update: int, length: int) -> float:
        """0 before the step and 1 after it; what moves with the schedule, such as collocation, follows this."""
        return float(update >= self.at * length)

    def __call__(self, update: int, length: int) -> Weights:
        """(w_TD, w_HJB, w_BC) at an update of a run, or a stage, of that length."""
        return self.final if self.progress(update, length) else self.initial
