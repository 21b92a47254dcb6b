"""Heat maps and paths on a plane of the state space."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from torch import Tensor

from pirl_rl.evaluation.slices import Section
from pirl_rl.sets import Box

CONTOURS = (0.1, 0.5, 0.9)

POWERS = (-3, 4)
"""Labels of ticks below and above these powers of ten have a common factor, since long ones overlap."""

TARGET, AVOID = "limegreen", "red"
"""The colours of the outlines of A and B."""


def draw_plane(axes: Axes, section: Section, values: Tensor) -> QuadMesh:
    """Draw a heat map of values (k, k) in [0, 1] on a section's grid, with contours of V; returns the heat map."""
    first, second = (axis.numpy() for axis in section.axes)
    mesh = axes.pcolormesh(first, second, values.numpy(), cmap="viridis", vmin=0, vmax=1, shading="nearest")
    lines = axes.contour(first, second, section.value.numpy(), CONTOURS, colors="white", linewidths=1)
    axes.clabel(lines, fontsize="x-small")
    draw_sets(axes, section)
    axes.set(xlabel=section.plane.axes[0], ylabel=section.plane.axes[1])
    axes.ticklabel_format(scilimits=POWERS)
    axes.set(xlim=(first[0], first[-1]), ylim=(second[0], second[-1]))
    return mesh


def draw_sets(axes: Axes, section: Section) -> None:
    """Draw the outlines of A and B on a section's grid."""
    for inside, color in ((section.reached, TARGET), (section.failed, AVOID)):
        if bool(inside.any()) and not bool(inside.all()):
            low, high = section.plane.box.low, section.plane.box.high
            first, second = (np.linspace(a, b, len(inside)) for a, b in zip(low, high, strict=True))
            axes.contour(first, second, inside.float().numpy(), [0.5], colors=color, linewidths=1.8)


def broken_at_seams(path: np.ndarray, box: Box) -> np.ndarray:
    """A path (k, 2) in the coordinates of a plane, with a row of NaN, which is not drawn, at every jump over a seam.

    A step of more than half a period of a periodic axis of the plane's box counts as a jump.
    """
    width = np.array(box.high) - np.array(box.low)
    circles = list(box.periodic)
    jumps = (np.abs(np.diff(path, axis=0)) > width / 2)[:, circles].any(-1)
    return np.insert(path, np.flatnonzero(jumps) + 1, np.nan, axis=0)
