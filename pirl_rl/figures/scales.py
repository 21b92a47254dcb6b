"""Logarithmic scales of axes and colours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes

DECADE = 10.0
"""Positive values whose largest is at least this many times their smallest get a logarithmic scale."""


def spans_decades(values: Sequence[float] | np.ndarray) -> bool:
    """Whether the finite values are positive and span at least one decade."""
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    return len(known) > 0 and bool(known.min() > 0) and bool(known.max() >= DECADE * known.min())


def log_scale(axes: Axes, axis: Literal["x", "y"], values: Sequence[float]) -> None:
    """Make an axis logarithmic, or write "not available" if no value is positive, as a logarithmic axis requires."""
    if any(value > 0 for value in values):
        axes.set(**{f"{axis}scale": "log"})
    else:
        axes.text(0.5, 0.5, "not available", ha="center", va="center", transform=axes.transAxes)
