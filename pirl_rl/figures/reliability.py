"""Reliability diagrams: how often paths succeed among states for which V promises about the same."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pirl_rl.evaluation.calibration import CalibrationEvidence
from pirl_rl.figures.evidence import draw

BINS = 10
"""The largest number of bins."""

LEAST = 20
"""The smallest number of states of a bin, if there are so many."""


def draw_reliability(axes: Axes, value: np.ndarray, simulated: Mapping[str, np.ndarray]) -> None:
    """Draw the mean of Monte Carlo over that of V, in bins of V with equally many states.

    Args:
        axes: where it is drawn.
        value: V (N,).
        simulated: Monte Carlo (N,), by label.
    """
    order = np.argsort(value, kind="stable")
    bins = np.array_split(order, max(1, min(BINS, len(value) // LEAST)))
    middle = [value[rows].mean() for rows in bins]
    axes.plot([0, 1], [0, 1], color="0.5", lw=1)
    for k, (label, mean) in enumerate(simulated.items()):
        height = [mean[rows].mean() for rows in bins]
        error = [mean[rows].std() / len(rows) ** 0.5 for rows in bins]
        axes.errorbar(middle, height, error, fmt="o-", color=f"C{k}", capsize=2, label=label)
    axes.set(xlabel="V, mean of a bin", ylabel="Monte Carlo, mean and standard error")
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.legend(fontsize="small", loc="upper left")


@draw.register
def draw_calibration(evidence: CalibrationEvidence) -> dict[str, Figure]:
    """A reliability diagram, and V beside Monte Carlo at every state."""
    comparison = evidence.comparison
    value, mean = comparison.value.numpy(), comparison.monte_carlo.numpy()
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_reliability(left, value, {f"{comparison.rollouts:,} paths from each state": mean})
    left.set_title(f"{len(value):,} states, in bins of equally many")
    spread = np.sqrt(mean * (1 - mean) / comparison.rollouts)
    right.plot([0, 1], [0, 1], color="0.5", lw=1)
    right.errorbar(value, mean, spread, fmt=".", ms=4, lw=0.6, color="C0", ecolor="0.6")
    right.set(title=f"mean |V - Monte Carlo| {comparison.mae():.4f}", xlabel="V", ylabel="Monte Carlo")
    right.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    return {"calibration": figure}
