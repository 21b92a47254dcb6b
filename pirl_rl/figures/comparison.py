"""The figure that compares groups of finished runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pirl_rl.figures.scales import log_scale

ERROR_METRICS = {"value_mse": "MSE against the exact V", "fine_mse_band": "MSE against Monte Carlo, target in reach"}
"""Metrics for the error of V with their labels, in the order of preference: the first that any run has is drawn."""

SHARE = "reward / optimal reward, where known"


class Curves(Protocol):
    """The data of a run that are drawn.

    Attributes:
        metrics: the columns (rows,) of metrics.csv, by name.
    """

    @property
    def metrics(self) -> Mapping[str, np.ndarray]: ...

    def get(self, name: str) -> float:
        """An entry of the summary, or NaN if it has none; "reward_share" is the reward over the optimal reward."""
        ...


Groups = Mapping[str, Sequence[Curves]]
"""Runs by the label of their group."""


def draw_comparison(groups: Groups) -> Figure:
    """Reward and MSE of every run, one against the other, and the held-out losses over training."""
    figure = Figure(figsize=(15, 8), layout="constrained")
    grid = figure.add_gridspec(2, 12)
    reward, mse, both = (figure.add_subplot(grid[0, 4 * i : 4 * i + 4]) for i in range(3))
    _per_seed(reward, groups, "reward_share", "Reward of each seed", SHARE)
    runs = [run for group in groups.values() for run in group]
    name = next((name for name in ERROR_METRICS if any(math.isfinite(run.get(name)) for run in runs)), "value_mse")
    _per_seed(mse, groups, name, "MSE of V of each seed", ERROR_METRICS[name])
    errors = [run.get(name) for run in runs]
    log_scale(mse, "y", errors)
    log_scale(both, "x", errors)
    _reward_against_mse(both, groups, name)
    for i, name in enumerate(("hjb_loss", "boundary_loss", "td_loss", "hjb_sup_loss")):
        axes = figure.add_subplot(grid[1, 3 * i : 3 * i + 3])
        for color, runs in _colored(groups):
            _evolution(axes, runs, name, color)
        axes.set(title=f"Held-out {name}", xlabel="update", ylabel="mean square" if i == 0 else "")
        log_scale(axes, "y", [value for line in axes.lines for value in line.get_ydata()])  # type: ignore[union-attr]
        axes.grid(alpha=0.3)
    handles, labels = both.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
    return figure


def _per_seed(axes: Axes, groups: Groups, name: str, title: str, ylabel: str) -> None:
    for i, (color, runs) in enumerate(_colored(groups)):
        values = np.array([run.get(name) for run in runs], dtype=float)
        values = values[np.isfinite(values)]
        if len(values):
            spread = np.linspace(-0.25, 0.25, len(values) + 2)[1:-1]
            axes.plot(i + spread, values, "o", ms=4, alpha=0.7, color=color)
            axes.plot([i - 0.35, i + 0.35], [values.mean()] * 2, color=color, lw=2)
    axes.set(title=f"{title}, line: mean", ylabel=ylabel, xlim=(-0.6, len(groups) - 0.4))
    axes.set_xticks(range(len(groups)), list(groups), fontsize="small", rotation=30, ha="right")
    axes.grid(axis="y", alpha=0.3)


def _reward_against_mse(axes: Axes, groups: Groups, error: str) -> None:
    for label, (color, runs) in zip(groups, _colored(groups), strict=True):
        pairs = np.array([(run.get(error), run.get("reward_share")) for run in runs])
        pairs = pairs[np.isfinite(pairs).all(-1)]
        axes.scatter(*pairs.T, s=14, alpha=0.6, color=color)
        # A group without such pairs gets an empty scatter, so that the legend has an entry for its colour.
        mean = pairs.mean(0, keepdims=True) if len(pairs) else pairs
        axes.scatter(*mean.T, s=130, color=color, edgecolors="black", label=label)
    axes.set(title="Reward against MSE, large: mean", xlabel=ERROR_METRICS[error], ylabel=SHARE)
    axes.grid(alpha=0.3)


def _evolution(axes: Axes, runs: Sequence[Curves], name: str, color: str) -> None:
    """Draw the median and the range over the runs at every update at which one of them was evaluated."""
    by_update: dict[float, list[float]] = {}
    for run in runs:
        for update, value in zip(run.metrics.get("update", ()), run.metrics.get(name, ()), strict=False):
            if math.isfinite(value):
                by_update.setdefault(float(update), []).append(float(value))
    updates = sorted(by_update)
    values = [by_update[update] for update in updates]
    axes.plot(updates, [np.median(entries) for entries in values], color=color)
    axes.fill_between(updates, list(map(min, values)), list(map(max, values)), color=color, alpha=0.2, lw=0)


def _colored(groups: Groups) -> list[tuple[str, Sequence[Curves]]]:
    return [(f"C{i % 10}", runs) for i, runs in enumerate(groups.values())]
