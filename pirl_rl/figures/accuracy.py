"""The figure of the accuracy on reference states."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pirl_rl.evaluation.accuracy import AccuracyEvidence
from pirl_rl.evaluation.reference_states import GROUPS
from pirl_rl.figures.evidence import draw

BINS = 10
"""Number of bins of V in the reliability diagram."""


@draw.register
def draw_accuracy(evidence: AccuracyEvidence) -> dict[str, Figure]:
    """A reliability diagram of the states that can reach the target, and the mean square error by distance."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_reliability(left, evidence)
    width = 0.8 / len(evidence.comparisons)
    for k, name in enumerate(evidence.comparisons):
        metrics = evidence.metrics_under(name)
        heights = [metrics[f"mse_{group}"] for group in GROUPS]
        label = f"{name} simulator: MSE {metrics['mse']:.4f}, success {metrics['success']:.3f}"
        right.bar(np.arange(len(GROUPS)) + (k + 0.5) * width - 0.4, heights, width, color=f"C{k}", label=label)
        right.axhline(metrics["noise"], color=f"C{k}", ls=":")
    right.set_xticks(range(len(GROUPS)), GROUPS)
    right.set(title=f"All {len(evidence.reachable)} states by distance; dotted: noise of Monte Carlo")
    right.set(ylabel="mean square of V - Monte Carlo", ylim=(0, 1.3 * right.get_ylim()[1]))
    right.legend(fontsize="small", loc="upper right")
    return {"accuracy": figure}


def _draw_reliability(axes: Axes, evidence: AccuracyEvidence) -> None:
    value = next(iter(evidence.comparisons.values())).value[evidence.reachable].numpy()
    which = np.clip((value * BINS).astype(int), 0, BINS - 1)
    counts = np.bincount(which, minlength=BINS)
    filled = counts > 0

    def means(values: np.ndarray) -> np.ndarray:
        return np.bincount(which, values, BINS)[filled] / counts[filled]

    axes.plot([0, 1], [0, 1], color="0.5", lw=1)
    for k, (name, comparison) in enumerate(evidence.comparisons.items()):
        mean = comparison.monte_carlo[evidence.reachable].numpy()
        height = means(mean)
        error = np.sqrt(np.maximum(means(mean**2) - height**2, 0) / counts[filled])
        axes.errorbar(means(value), height, error, fmt="o-", color=f"C{k}", capsize=2, label=f"{name} simulator")
    for i, count in enumerate(counts):
        axes.text((i + 0.5) / BINS, -0.05, f"{count}", ha="center", va="center", fontsize="small", color="0.4")
    axes.set(title=f"{len(value)} states that can reach the target; grey: states in the bin", xlabel="learned V")
    axes.set(ylabel="Monte Carlo, mean and standard error", xlim=(0, 1), ylim=(-0.1, 1.02))
    axes.legend(fontsize="small", loc="upper left")
