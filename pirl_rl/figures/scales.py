"""Logarithmic scales, where the values allow one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes

DECADE = 10.0
"""Positive numbers whose largest and smallest are this far apart are shown on a logarithmic scale."""


def spans_decades(values: Sequence[float] | np.ndarray) -> bool:
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    return len(known) > 0 and bool(known.min() > 0) and bool(known.max() >= DECADE * known.min())


def log_scale(axes: Axes, axis: Literal["x", "y"], values: Sequence[float]) -> None:
    """A logarithmic axis; where no value is positive, which such an axis refuses, a word instead."""
    if any(value > 0 for value in values):
        axes.set(**{f"{axis}scale": "log"})
    else:
        axes.text(0.5, 0.5, "not available", ha="center", va="center", transform=axes.transAxes)
