"""The figure of the suite: the quality of all runs by problem, and the time of training over the number of states."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

PANELS = {
    "mse": "mean square error of V",
    "loss": "loss of success",
    "gap": "mean |V - Monte Carlo|",
}
"""The measured quantities that are drawn by problem, with their labels."""

FAMILY = re.compile(r"(\w+)-(\d+)")
"""The name of a problem that comes in several dimensions, such as halfspace-32."""


def draw_suite(scores: Mapping[str, Sequence[Mapping[str, float]]]) -> Figure:
    """Dots for all seeds of each problem.

    Args:
        scores: the entries of the scores of all seeds, by the name of the problem.
    """
    figure = Figure(figsize=(14, 1.8 + 0.3 * len(scores)), layout="constrained")
    panels = figure.subplots(1, len(PANELS) + 1, width_ratios=[1] * len(PANELS) + [1.2])
    for panel, (key, label) in zip(panels, PANELS.items(), strict=False):
        _draw_problems(panel, {name: [run[key] for run in runs] for name, runs in scores.items()})
        panel.set_xlabel(label)
        panel.tick_params(axis="y", labelleft=panel is panels[0])
    for panel in panels[1:-1]:
        panel.locator_params(axis="x", nbins=4)
    if any(run["mse"] > 0 for runs in scores.values() for run in runs):
        panels[0].set_xscale("log")
    _draw_times(panels[-1], scores)
    return figure


def _draw_problems(panel: Axes, values: Mapping[str, Sequence[float]]) -> None:
    for row, runs in enumerate(values.values()):
        panel.plot(runs, [row] * len(runs), "o", color="C0", ms=4, alpha=0.6)
    panel.set_yticks(range(len(values)), list(values))
    panel.set_ylim(len(values) - 0.5, -0.5)  # the same in all panels, also where a problem has no truth
    panel.grid(alpha=0.3)


def _draw_times(panel: Axes, scores: Mapping[str, Sequence[Mapping[str, float]]]) -> None:
    families: dict[str, dict[int, float]] = {}
    for name, runs in scores.items():
        if found := FAMILY.fullmatch(name):
            # Other processes on the machine only lengthen a time.
            families.setdefault(found[1], {})[int(found[2])] = min(run["seconds"] for run in runs)
    for family, times in families.items():
        panel.plot(sorted(times), [times[n] for n in sorted(times)], "o-", label=family)
    if families:
        numbers = sorted({n for times in families.values() for n in times})
        panel.set_xscale("log")
        panel.set_xticks(numbers, list(map(str, numbers)))
        panel.minorticks_off()
        panel.set_ylim(bottom=0)
        panel.legend()
    panel.set(xlabel="number of states n", ylabel="time of training, fastest seed (s)")
    panel.grid(alpha=0.3)
