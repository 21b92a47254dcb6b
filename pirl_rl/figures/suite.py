"""The figure of the suite: the quality of all runs by problem, and the time of training over the number of states."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

PANELS = {
    "mse": "mean square error of V",
    "loss": "loss of success",
    "gap": "mean |V - Monte Carlo|, grey: noise alone",
}
"""The measured quantities that are drawn by problem, with their labels."""

ERROR_BARS: dict[str, Any] = {"fmt": "none", "ecolor": "C0", "elinewidth": 0.8, "alpha": 0.5}
"""The style of the bars of standard errors."""

FAMILY = re.compile(r"(\w+)-(\d+)")
"""The name of a problem that comes in several dimensions, such as halfspace-32."""


def draw_suite(scores: Mapping[str, Sequence[Mapping[str, float]]]) -> Figure:
    """Dots for all seeds of each problem, with the standard error of the loss and the noise in the distance.

    The last panel has the time of training of problems that come in several dimensions. It is left out where the scores
    have one number of states.

    Args:
        scores: the entries of the scores of all seeds, by the name of the problem.
    """
    families = _times(scores)
    widths = [1.0] * len(PANELS) + [1.2] * bool(families)
    figure = Figure(figsize=(2 + 3 * len(widths), 1.8 + 0.3 * len(scores)), layout="constrained")
    panels = figure.subplots(1, len(widths), width_ratios=widths)
    for panel, (key, label) in zip(panels, PANELS.items(), strict=False):
        _draw_problems(panel, {name: [run[key] for run in runs] for name, runs in scores.items()})
        panel.set_xlabel(label)
        panel.tick_params(axis="y", labelleft=panel is panels[0])
    mse, loss, gap = panels[: len(PANELS)]
    for row, runs in enumerate(scores.values()):
        errors = [run["loss_error"] for run in runs]
        loss.errorbar([run["loss"] for run in runs], [row] * len(runs), xerr=errors, **ERROR_BARS)
        gap.plot([run["gap_noise"] for run in runs], [row] * len(runs), "|", color="gray", ms=10)
    for panel in (loss, gap):
        panel.locator_params(axis="x", nbins=4)
    if any(run["mse"] > 0 for runs in scores.values() for run in runs):
        _scale_by_decades(mse)
    if families:
        _draw_times(panels[-1], families)
    return figure


def _draw_problems(panel: Axes, values: Mapping[str, Sequence[float]]) -> None:
    for row, runs in enumerate(values.values()):
        panel.plot(runs, [row] * len(runs), "o", color="C0", ms=4, alpha=0.6)
    panel.set_yticks(range(len(values)), list(values))
    panel.set_ylim(len(values) - 0.5, -0.5)  # the same in all panels, also where a problem has no truth
    panel.grid(alpha=0.3)


def _scale_by_decades(panel: Axes) -> None:
    """A logarithmic axis of whole decades, whose labels do not overlap where the values lie close together."""
    panel.set_xscale("log")
    low, high = math.log10(panel.dataLim.minposx / 1.1), math.log10(panel.dataLim.x1 * 1.1)
    panel.set_xlim(10.0 ** math.floor(low), 10.0 ** math.ceil(high))
    panel.xaxis.set_minor_formatter(NullFormatter())


def _times(scores: Mapping[str, Sequence[Mapping[str, float]]]) -> dict[str, dict[int, float]]:
    """The shortest time of training, in s, by family and number of states; nothing where there is one number."""
    families: dict[str, dict[int, float]] = {}
    for name, runs in scores.items():
        if found := FAMILY.fullmatch(name):
            # Other processes on the machine only lengthen a time.
            families.setdefault(found[1], {})[int(found[2])] = min(run["seconds"] for run in runs)
    return families if len({n for times in families.values() for n in times}) > 1 else {}


def _draw_times(panel: Axes, families: Mapping[str, Mapping[int, float]]) -> None:
    for family, times in families.items():
        panel.plot(sorted(times), [times[n] for n in sorted(times)], "o-", label=family)
    numbers = sorted({n for times in families.values() for n in times})
    panel.set_xscale("log")
    panel.set_xticks(numbers, list(map(str, numbers)))
    panel.minorticks_off()
    panel.set_ylim(0, 1.1 * max(max(times.values()) for times in families.values()))
    panel.legend()
    panel.set(xlabel="number of states n", ylabel="time of training, fastest seed (s)")
    panel.grid(alpha=0.3)
