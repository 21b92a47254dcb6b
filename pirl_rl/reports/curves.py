"""The curves of a training: losses, weights and what was measured, over updates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pirl_rl.figures.scales import spans_decades
from pirl_rl.figures.training import HELD_OUT, TRAINING, WEIGHTS

PANELS = (
    ("Losses of training, summed over critics", TRAINING, True),
    ("Held-out losses", HELD_OUT, True),
    (
        "Success of the policy during training",
        {"success_rate": "success", "success_low": "lower bound, 95%", "success_high": "upper bound, 95%"},
        False,
    ),
    ("Weights of the losses", WEIGHTS, False),
    ("Learning rate", {"learning_rate": "learning rate"}, False),
)
"""Titles of panels, with the labels of the columns of metrics.csv in each, and whether their scale may be logarithmic.
"""

MOST_POINTS = 400
"""The largest number of points of a curve; of longer ones every second, third or so on is kept, and the last."""


def training_curves(metrics: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Panels with curves, and the updates at which stages began.

    Args:
        metrics: the columns (rows,) of metrics.csv, by name; nothing where the run has none.
    """
    panels = []
    for title, labels, losses in PANELS:
        curves = [_curve(metrics, name, label) for name, label in labels.items() if name in metrics]
        curves = [curve for curve in curves if curve["y"]]
        if curves:
            log = losses and spans_decades([value for curve in curves for value in curve["y"]])
            panels.append({"title": title, "curves": curves, "log": log})
    stages: list[float] = []
    if "stage" in metrics:
        stages = metrics["update"][1:][np.diff(metrics["stage"]) != 0].tolist()
    return {"panels": panels, "stages": stages}


def _curve(metrics: Mapping[str, np.ndarray], name: str, label: str) -> dict[str, Any]:
    known = np.flatnonzero(np.isfinite(metrics[name]))
    every = -(-len(known) // MOST_POINTS) or 1
    kept = known[(np.arange(len(known)) % every == 0) | (np.arange(len(known)) == len(known) - 1)]
    return {"name": name, "label": label, "x": metrics["update"][kept].tolist(), "y": metrics[name][kept].tolist()}
