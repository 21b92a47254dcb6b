"""Figures of slices: V with the directions of the closed loop, Monte Carlo, and the policy, on a plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pirl_rl.evaluation.monte_carlo import expected_deviation
from pirl_rl.evaluation.slices import Section, Slice, SlicesEvidence
from pirl_rl.figures.evidence import draw
from pirl_rl.figures.planes import draw_plane, draw_sets

MOST_CONTROLS = 3
"""The largest number of components of the control that are drawn."""

ARROWS = 11
"""Largest number of arrows of the vector field along each axis."""


@draw.register
def draw_slices(evidence: SlicesEvidence) -> dict[str, Figure]:
    """Two figures for each plane: V beside Monte Carlo, and the policy."""
    slices = {f"slice_{name}": draw_slice(cut) for name, cut in evidence.slices.items()}
    return slices | {f"policy_{name}": draw_policy_slice(cut) for name, cut in evidence.slices.items()}


def draw_slice(cut: Slice) -> Figure:
    """V with the directions of the closed loop, beside Monte Carlo with the contours of V."""
    section = cut.section
    gap = f"mean |difference| {cut.mae:.3f}"
    if cut.rollouts > 1:
        gap += f", of which noise {expected_deviation(section.value, cut.rollouts):.3f}"
    titles = (f"V, τ = {section.time:g} s", f"Monte Carlo of the policy, with lines of V;\n{gap}")
    figure = Figure(figsize=(10.4, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, title, values in zip((left, right), titles, (section.value, cut.monte_carlo), strict=True):
        mesh = draw_plane(axes, section, values)
        axes.set_title(title)
    _draw_field(left, section, cut.field.numpy())
    figure.colorbar(mesh, ax=(left, right), label="probability")
    return figure


def draw_policy_slice(cut: Slice) -> Figure:
    """Heat maps of the control, at most `MOST_CONTROLS` components of it, between their bounds."""
    section = cut.section
    first, second = (axis.numpy() for axis in section.axes)
    shown = min(cut.action.shape[-1], MOST_CONTROLS)
    figure = Figure(figsize=(0.8 + 4.4 * shown, 4.2), layout="constrained")
    panels = figure.subplots(1, shown, squeeze=False, sharex=True, sharey=True)[0]
    for i, axes in enumerate(panels):
        action = cut.action[..., i].numpy()
        mesh = axes.pcolormesh(first, second, action, cmap="coolwarm", vmin=-1, vmax=1, shading="nearest")
        draw_sets(axes, section)
        name = "u" if cut.action.shape[-1] == 1 else f"u_{{{i + 1}}}"
        axes.set(title=f"Control ${name}$, τ = {section.time:g} s")
        axes.set(xlabel=section.plane.axes[0], ylabel=section.plane.axes[1])
    figure.colorbar(mesh, ax=list(panels), label="control, from its lower to its upper bound")
    return figure


def _draw_field(axes: Axes, section: Section, field: np.ndarray) -> None:
    """Draw the directions of the vector field as arrows of equal length, with both axes scaled by the box."""
    half = (np.array(section.plane.box.high) - np.array(section.plane.box.low)) / 2
    length = np.linalg.norm(field / half, axis=-1, keepdims=True)
    # A point that stands still in the plane, such as a position at rest, has no arrow, nor has one in A or B, where
    # paths have ended.
    ended = (section.reached | section.failed).numpy()
    nearest = np.linspace(0, len(ended) - 1, len(field)).round().astype(int)
    moves = (length > 0) & ~ended[np.ix_(nearest, nearest)][..., None]
    arrows = np.where(moves, field / np.where(moves, length, 1), np.nan)
    first, second = (axis.numpy() for axis in section.axes)
    every = slice(None, None, -(-len(first) // ARROWS))
    shown = arrows[every, every]
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 0.6 * ARROWS, "pivot": "mid"}
    style |= {"width": 0.006, "color": "white", "edgecolor": "black", "linewidth": 0.6}
    axes.quiver(first[every], second[every], shown[..., 0], shown[..., 1], **style)
