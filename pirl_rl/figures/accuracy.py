"""The figure of the accuracy on reference states."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pirl_rl.evaluation.accuracy import AccuracyEvidence
from pirl_rl.evaluation.reference_states import GROUPS
from pirl_rl.figures.evidence import draw
from pirl_rl.figures.reliability import draw_reliability


@draw.register
def draw_accuracy(evidence: AccuracyEvidence) -> dict[str, Figure]:
    """A reliability diagram of the states that can reach the target, and the mean square error by distance."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    value = next(iter(evidence.comparisons.values())).value[evidence.reachable].numpy()
    simulated = {
        f"{name} simulator": c.monte_carlo[evidence.reachable].numpy() for name, c in evidence.comparisons.items()
    }
    draw_reliability(left, value, simulated)
    left.set_title(f"{len(value)} states that can reach the target")
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
