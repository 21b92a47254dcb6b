"""Heat maps on a plane of the state space."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from torch import Tensor

from pirl_rl.evaluation.slices import Section

CONTOURS = (0.1, 0.5, 0.9)


def draw_plane(axes: Axes, section: Section, values: Tensor) -> QuadMesh:
    """Draw a heat map and contours of values (k, k) in [0, 1] on a section's grid; returns the heat map."""
    first, second = (axis.numpy() for axis in section.axes)
    mesh = axes.pcolormesh(first, second, values.numpy(), cmap="viridis", vmin=0, vmax=1, shading="nearest")
    lines = axes.contour(first, second, values.numpy(), CONTOURS, colors="white", linewidths=1)
    axes.clabel(lines, fontsize="x-small")
    axes.set(xlabel=section.plane.axes[0], ylabel=section.plane.axes[1])
    axes.set(xlim=(first[0], first[-1]), ylim=(second[0], second[-1]))
    return mesh
