"""How evidence is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from pirl_rl.evaluation.reference_states import GROUPS
from pirl_rl.evaluation.trajectories import Trajectories

if TYPE_CHECKING:
    from pirl_rl.evaluation.accuracy import AccuracyEvidence
    from pirl_rl.evaluation.slices import Section, Slice

BINS = 10
CONTOURS = (0.1, 0.5, 0.9)
ARROWS = 11
"""Of the vector field, along each axis at most."""
BEYOND = "0.5"
"""Where paths leave the box of a plane."""
ENDS = {"reached": ("o", "limegreen"), "failed": ("X", "red"), "out of time": ("s", "white")}
STARTS = ("white", "gold", "deepskyblue")


def draw_accuracy(evidence: AccuracyEvidence) -> Figure:
    """Reliability diagram of the states that can reach the target, and mean square error by distance."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_reliability(left, evidence)
    width = 0.8 / len(evidence.monte_carlo)
    for k, name in enumerate(evidence.monte_carlo):
        numbers = evidence.numbers_of(name)
        heights = [numbers[f"mse_{group}"] for group in GROUPS]
        label = f"{name} simulator: MSE {numbers['mse']:.4f}, success {numbers['success']:.3f}"
        right.bar(np.arange(len(GROUPS)) + (k + 0.5) * width - 0.4, heights, width, color=f"C{k}", label=label)
        right.axhline(numbers["noise"], color=f"C{k}", ls=":")
    right.set_xticks(range(len(GROUPS)), GROUPS)
    right.set(title=f"All {len(evidence.value)} states by distance; dotted: noise of Monte Carlo")
    right.set(ylabel="mean square of V - Monte Carlo", ylim=(0, 1.3 * right.get_ylim()[1]))
    right.legend(fontsize="small", loc="upper right")
    return figure


def _draw_reliability(axes: Axes, evidence: AccuracyEvidence) -> None:
    value = evidence.value[evidence.reachable].numpy()
    which = np.clip((value * BINS).astype(int), 0, BINS - 1)
    counts = np.bincount(which, minlength=BINS)
    filled = counts > 0

    def means(values: np.ndarray) -> np.ndarray:
        return np.bincount(which, values, BINS)[filled] / counts[filled]

    axes.plot([0, 1], [0, 1], color="0.5", lw=1)
    for k, (name, payoff) in enumerate(evidence.monte_carlo.items()):
        mean = payoff[evidence.reachable].numpy()
        height = means(mean)
        error = np.sqrt(np.maximum(means(mean**2) - height**2, 0) / counts[filled])
        axes.errorbar(means(value), height, error, fmt="o-", color=f"C{k}", capsize=2, label=f"{name} simulator")
    for i, count in enumerate(counts):
        axes.text((i + 0.5) / BINS, -0.05, f"{count}", ha="center", va="center", fontsize="small", color="0.4")
    axes.set(title=f"{len(value)} states that can reach the target; grey: in the bin", xlabel="learned V")
    axes.set(ylabel="Monte Carlo, mean and standard error", xlim=(0, 1), ylim=(-0.1, 1.02))
    axes.legend(fontsize="small", loc="upper left")


def draw_slice(cut: Slice) -> Figure:
    """Learned V with the closed loop's directions, beside Monte Carlo."""
    section = cut.section
    mae = (section.value - cut.monte_carlo).abs().mean()
    titles = (f"Learned V, τ = {section.tau[0]:g} s", f"Monte Carlo of the policy, mean |difference| {mae:.3f}")
    figure = Figure(figsize=(10.4, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, title, values in zip((left, right), titles, (section.value, cut.monte_carlo), strict=True):
        mesh = _draw_value(axes, section, values)
        axes.set_title(title)
    _draw_field(left, section, cut.field.numpy())
    figure.colorbar(mesh, ax=(left, right), label="probability")
    return figure


def _draw_value(axes: Axes, section: Section, values: torch.Tensor):
    first, second = (axis.numpy() for axis in section.axes)
    mesh = axes.pcolormesh(first, second, values.numpy(), cmap="viridis", vmin=0, vmax=1, shading="nearest")
    lines = axes.contour(first, second, values.numpy(), CONTOURS, colors="white", linewidths=1)
    axes.clabel(lines, fontsize="x-small")
    axes.set(xlabel=section.plane.axes[0], ylabel=section.plane.axes[1])
    axes.set(xlim=(first[0], first[-1]), ylim=(second[0], second[-1]))
    return mesh


def _draw_field(axes: Axes, section: Section, field: np.ndarray) -> None:
    """Directions on paper: arrows of one length, in axes scaled by the box."""
    half = (np.array(section.plane.box.high) - np.array(section.plane.box.low)) / 2
    length = np.linalg.norm(field / half, axis=-1, keepdims=True)
    arrows = field / np.where(length > 0, length, 1)
    first, second = (axis.numpy() for axis in section.axes)
    some = slice(None, None, -(-len(first) // ARROWS))
    shown = arrows[some, some]
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 0.6 * ARROWS, "pivot": "mid"}
    style |= {"width": 0.006, "color": "white", "edgecolor": "black", "linewidth": 0.6}
    axes.quiver(first[some], second[some], shown[..., 0], shown[..., 1], **style)


def draw_rollouts(sections: Sequence[Section], paths: Trajectories, values: Sequence[float]) -> Figure:
    """Paths projected into every plane over the contours of V at the whole horizon, starts and ends marked.

    Args:
        values: V at the starts, of as many paths each.
    """
    figure = Figure(figsize=(0.8 + 4.8 * len(sections), 4.8), layout="constrained")
    ended = zip(paths.reached.tolist(), paths.failed.tolist(), strict=True)
    ends = ["reached" if reached else "failed" if failed else "out of time" for reached, failed in ended]
    each = len(ends) // len(values)
    all_axes = figure.subplots(1, len(sections), squeeze=False)[0]
    for axes, section in zip(all_axes, sections, strict=True):
        mesh = _draw_value(axes, section, section.value)
        axes.set_facecolor(BEYOND)
        projected = section.plane.project(paths.state).numpy()
        for i, end in enumerate(ends):
            line = projected[: paths.steps[i] + 1, i]
            axes.plot(*line.T, color=STARTS[i // each], lw=0.8)
            axes.plot(*line[0], "D", color=STARTS[i // each], mec="black", mew=0.6, ms=6, zorder=3)
            axes.plot(*line[-1], ENDS[end][0], color=ENDS[end][1], mec="black", mew=0.6, ms=6, zorder=3)
        axes.autoscale()
    figure.colorbar(mesh, ax=list(all_axes), label=f"learned V, τ = {sections[0].tau[0]:g} s")
    starts = zip(STARTS, values, strict=True)
    handles: list[Artist] = [
        Line2D([], [], color=c, marker="D", mec="black", label=f"from V = {value:.2f}") for c, value in starts
    ]
    handles += [
        Line2D([], [], ls="", marker=marker, color=color, mec="black", label=f"{end}: {ends.count(end)}")
        for end, (marker, color) in ENDS.items()
    ]
    handles.append(Patch(color=BEYOND, label="beyond the plane"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize="small", facecolor="0.7")
    return figure
