"""What commands say on the terminal: help, phases and the progress of training; and stopping it with Ctrl-C."""

from __future__ import annotations

import math
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from tqdm import tqdm

EVALUATED = ("value_mse", "success_rate", "calibration_mse", "hjb_loss", "td_loss")
TRAINED = ("train_td_loss", "train_hjb_loss", "train_boundary_loss")
"""The metrics that are shown: those of an evaluation, or between evaluations those of training."""


def announce(phase: str) -> None:
    """Say which phase of a command begins, above the progress bar if there is one."""
    tqdm.write(phase, file=sys.stderr)
    sys.stderr.flush()


def helped(arguments: Sequence[str], text: str | None) -> bool:
    """Print the help of a command where its arguments ask for it; returns whether they do."""
    if not {"-h", "--help"} & {*arguments}:
        return False
    print(text)
    return True


class Progress:
    """A progress bar on a terminal. Elsewhere plain lines, at each evaluation and after each tenth of the run.

    The bar shows the losses of the last row, and the metrics of the last evaluation with the update at which it was.

    Args:
        total: updates of the run.
        done: updates made before, if the run is resumed.
    """

    def __init__(self, total: int, done: int):
        self.bar = tqdm(total=total, initial=done, unit="update", disable=None, dynamic_ncols=True)
        self.total, self.shown, self._last_evaluation = total, done, ""

    def show(self, update: int, row: Mapping[str, float]) -> None:
        """Show the number of updates made, and the metrics of a row, which may be empty."""
        if not self.bar.disable:
            self.bar.update(update - self.bar.n)
        evaluated, trained = _listed(row, EVALUATED), _listed(row, TRAINED)
        if not self.bar.disable:
            if evaluated:
                self._last_evaluation = f" | at update {update}: {evaluated}"
            if row:
                self.bar.set_postfix_str(trained + self._last_evaluation)
        elif evaluated or (row and update - self.shown >= self.total / 10):
            print(f"update {update}/{self.total}: {evaluated or trained}", file=sys.stderr, flush=True)
            self.shown = update

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exception) -> None:
        self.bar.close()


def _listed(row: Mapping[str, float], names: Sequence[str]) -> str:
    return ", ".join(f"{name} {row[name]:.3g}" for name in names if not math.isnan(row.get(name, math.nan)))


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Let SIGINT set a flag in place of raising an exception, so that training stops between two updates.

    A second SIGINT raises `KeyboardInterrupt`.

    Yields:
        A function that tells whether SIGINT came. Outside the main thread it is always false.
    """
    asked = False

    def ask(number, frame):
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print("\nstopping after this update; Ctrl-C again stops at once", file=sys.stderr, flush=True)

    try:
        previous = signal.signal(signal.SIGINT, ask)
    except ValueError:  # signals reach only the main thread
        yield lambda: False
        return
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, previous)
