"""Figures of a metric over one or two settings of a sweep."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from pirl_rl.figures.scales import spans_decades


def draw_grid(metric: str, axes: Mapping[str, Sequence[str]], values: np.ndarray, texts: np.ndarray) -> Figure:
    """A heat map of a metric over two settings, with a text in every cell; cells without a value are grey.

    Args:
        metric: name of the metric.
        axes: values of the two settings by their names, the setting of the rows first.
        values: the metric (rows, columns), NaN in cells without a value.
        texts: texts of the cells (rows, columns).
    """
    (row_name, rows), (column_name, columns) = axes.items()
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    scale = LogNorm(low, high) if spans_decades(values) else Normalize(low, high)
    figure = Figure(figsize=(2.5 + 1.05 * len(columns), 1.8 + 0.6 * len(rows)), layout="constrained")
    panel = figure.add_subplot()
    panel.set_facecolor("0.88")
    image = panel.imshow(np.ma.masked_invalid(values), norm=scale, cmap="viridis", origin="lower", aspect="auto")
    for (i, j), text in np.ndenumerate(texts):
        bright = math.isfinite(values[i, j]) and float(scale(values[i, j])) < 0.6
        panel.text(j, i, text, ha="center", va="center", fontsize="small", color="white" if bright else "black")
    panel.set_xticks(range(len(columns)), columns)
    panel.set_yticks(range(len(rows)), rows)
    panel.set(xlabel=column_name, ylabel=row_name, title=f"{metric}, mean of the runs")
    figure.colorbar(image, ax=panel, label=metric)
    return figure


def draw_line(metric: str, setting: str, runs: Mapping[str, Sequence[float]]) -> Figure:
    """The metric of every run and its mean over the values of one setting, with a cross where all runs failed.

    Args:
        metric: name of the metric.
        setting: name of the setting.
        runs: the metric of all runs by the value of the setting; NaN for a run that failed.
    """
    figure = Figure(figsize=(6, 4), layout="constrained")
    panel = figure.add_subplot()
    places, numeric = _places(list(runs))
    ended = [np.array([value for value in values if not math.isnan(value)]) for values in runs.values()]
    for place, values in zip(places, ended, strict=True):
        panel.plot([place] * len(values), values, "o", color="C0", ms=4, alpha=0.6)
        if not len(values):
            panel.plot(place, 0.03, "x", color="C3", transform=panel.get_xaxis_transform())
            panel.annotate("failed", (place, 0.06), xycoords=panel.get_xaxis_transform(), color="C3", ha="center")
    panel.plot(places, [values.mean() if len(values) else math.nan for values in ended], color="C0")
    if spans_decades(np.concatenate(ended)):
        panel.set_yscale("log")
    if numeric and spans_decades(places):
        panel.set_xscale("log")
    if not numeric:
        panel.set_xticks(range(len(runs)), list(runs))
    panel.set(xlabel=setting, ylabel=metric, title=f"{metric}, line: mean")
    panel.grid(alpha=0.3)
    return figure


def _places(values: Sequence[str]) -> tuple[list[float], bool]:
    """The positions of a setting's values on an axis, and whether they are the values themselves, all being numbers."""
    try:
        return [float(value) for value in values], True
    except ValueError:
        return [float(index) for index in range(len(values))], False
