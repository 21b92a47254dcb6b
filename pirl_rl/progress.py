"""What a user sees of the loop, and how he stops it."""

from __future__ import annotations

import math
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from tqdm import tqdm

EVALUATED = ("value_mse", "success_rate", "calibration_mse", "hjb_loss", "td_loss")
TRAINED = ("train_td_loss", "train_hjb_loss", "train_boundary_loss")
"""What the progress shows, of an evaluation and between evaluations."""


class Progress:
    """A bar on a terminal; elsewhere plain lines, at each evaluation and each tenth of the run."""

    def __init__(self, total: int, done: int):
        self.bar = tqdm(total=total, initial=done, unit="update", disable=None, dynamic_ncols=True)
        self.total, self.shown = total, done

    def show(self, update: int, row: Mapping[str, float]) -> None:
        if not self.bar.disable:
            self.bar.update(update - self.bar.n)
        evaluated = any(name in row for name in EVALUATED)
        names = EVALUATED if evaluated else TRAINED
        text = ", ".join(f"{name} {row[name]:.3g}" for name in names if not math.isnan(row.get(name, math.nan)))
        if not self.bar.disable:
            if evaluated or (row and not self.bar.postfix):
                self.bar.set_postfix_str(text)
        elif evaluated or (row and update - self.shown >= self.total / 10):
            print(f"update {update}/{self.total}: {text}", file=sys.stderr, flush=True)
            self.shown = update

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exception) -> None:
        self.bar.close()


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """SIGINT raises a flag instead of an exception, so that the loop ends between two updates; a second one kills."""
    asked = False

    def ask(number, frame):
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print("\nstopping after this update; Ctrl-C again stops at once", file=sys.stderr, flush=True)

    try:
        previous = signal.signal(signal.SIGINT, ask)
    except ValueError:  # not in the main thread: nobody sends us signals there
        yield lambda: False
        return
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, previous)
