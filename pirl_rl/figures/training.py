"""The figure of a training: losses and loss weights over updates."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pirl_rl.figures.scales import log_scale

TRAINING = {"train_td_loss": "TD", "train_hjb_loss": "HJB", "train_boundary_loss": "boundary"}
HELD_OUT = {
    "td_loss": "TD",
    "hjb_loss": "HJB",
    "boundary_loss": "boundary",
    "hjb_sup_loss": "HJB, sup over u",
    "value_mse": "MSE of V",
}
WEIGHTS = {"td_weight": "TD", "hjb_weight": "HJB", "boundary_weight": "boundary"}
STYLES = {"TD": "C0-", "HJB": "C1-", "boundary": "C2--", "HJB, sup over u": "C3--", "MSE of V": "C4-"}


def draw_training(metrics: Mapping[str, np.ndarray]) -> Figure:
    """Training losses, held-out losses and loss weights over updates.

    Args:
        metrics: the columns (rows,) of metrics.csv, by name.
    """
    figure = Figure(figsize=(7, 8), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    _curves(top, metrics, TRAINING, "Training losses, summed over critics")
    _curves(middle, metrics, HELD_OUT, "Held-out losses", marker=".")
    _curves(bottom, metrics, WEIGHTS, "Loss weights")
    for axes in (top, middle):
        axes.set_ylabel("loss")
        log_scale(axes, "y", [value for line in axes.lines for value in line.get_ydata()])  # type: ignore[union-attr]
    bottom.set(xlabel="update", ylabel="weight")
    bottom.set_ylim(bottom=0)
    if "stage" in metrics:
        for update in metrics["update"][1:][np.diff(metrics["stage"]) != 0]:
            for axes in (top, middle, bottom):
                axes.axvline(update, color="0.4", ls=":")
        bottom.set_xlabel("update; dotted: start of a stage")
    return figure


def _curves(axes: Axes, metrics: Mapping[str, np.ndarray], names: dict[str, str], title: str, marker: str = "") -> None:
    for name, label in names.items():
        if name in metrics and np.isfinite(metrics[name]).any():
            known = np.isfinite(metrics[name])
            axes.plot(metrics["update"][known], metrics[name][known], STYLES[label], marker=marker, label=label)
    axes.set_title(title)
    axes.grid(alpha=0.3)
    if axes.lines:
        axes.legend(fontsize="small")
