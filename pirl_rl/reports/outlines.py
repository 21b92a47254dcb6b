"""Pictures of the sets of a problem on its planes, as paths of SVG.

They show more than the box of states, since nothing happens at its edge and the avoid set often lies beyond it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from contourpy import FillType, contour_generator
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.reports.names import as_html, split_unit, state_names
from pirl_rl.sets import Box, Plane

POINTS = 161
"""The number of points along each axis at which the levels of the sets are computed."""

MARGIN = 1.25
"""The width of a picture over that of the box."""

WIDTH, HEIGHT, STRIP = 300.0, 240.0, 36.0
"""The size of a picture in pixels, and the height of that of a problem with one state."""


def outlines(problem: ReachAvoidProblem, planes: Mapping[str, Plane]) -> list[dict[str, Any]]:
    """A picture of both sets on each plane, or on the line where the problem has one state."""
    if problem.states.dim == 1:
        label = as_html(state_names(problem)[0])
        box = Box([problem.states.low[0], 0.0], [problem.states.high[0], 1.0], [*problem.states.periodic, 1])
        return [_picture(problem, "", (label, ""), box, lambda points: points[..., :1], STRIP)]
    return [
        _picture(
            problem, name, (as_html(plane.axes[0]), as_html(plane.axes[1])), plane.box, plane.embed, _height(plane)
        )
        for name, plane in planes.items()
    ]


def _height(plane: Plane) -> float:
    if not equal_scales(plane):
        return HEIGHT
    width, height = (b - a for a, b in zip(plane.box.low, plane.box.high, strict=True))
    return min(max(WIDTH * height / width, HEIGHT / 3), 1.5 * WIDTH)


def levels_of(problem: ReachAvoidProblem, x: Tensor) -> dict[str, Tensor]:
    """The levels (N,) of the sets that a problem has, "target" and "avoid", at states (N, n).

    One that is infinite, or not a number, becomes as large as the largest of the others.
    """
    levels = {}
    if problem.objective == "reach-avoid":
        levels["target"] = problem.reached_constraints(x).amax(-1)
    if problem.has_avoid_set:
        levels["avoid"] = problem.avoid_level(x)
    return {name: _finite(level.double()) for name, level in levels.items()}


def _finite(level: Tensor) -> Tensor:
    numbers = level[level.isfinite()]
    far = float(numbers.abs().max()) if len(numbers) else 1.0
    return level.nan_to_num(far, far, -far)


def equal_scales(plane: Plane) -> bool:
    """Whether both axes of a plane have the same unit, so that a circle must look like one."""
    units = [split_unit(axis)[1] for axis in plane.axes]
    return units[0] == units[1] != ""


def _picture(
    problem: ReachAvoidProblem,
    name: str,
    labels: tuple[str, str],
    box: Box,
    embed: Callable[[Tensor], Tensor],
    height: float,
) -> dict[str, Any]:
    shown = box.expand(MARGIN)
    axes = [np.linspace(a, b, POINTS) for a, b in zip(shown.low, shown.high, strict=True)]
    points = torch.from_numpy(np.stack(np.meshgrid(*axes), -1))
    levels = levels_of(problem, problem.states.wrap(embed(points.reshape(-1, 2))))

    def place(values: np.ndarray, axis: int) -> np.ndarray:
        share = (values - shown.low[axis]) / (shown.high[axis] - shown.low[axis])
        return WIDTH * share if axis == 0 else height * (1 - share)

    def path(level: Tensor) -> str:
        z = level.reshape(POINTS, POINTS).numpy()
        found = contour_generator(axes[0], axes[1], z, fill_type=FillType.OuterOffset).filled(-np.inf, 0.0)
        rings = [ring for points, offsets in zip(*found, strict=True) for ring in np.split(points, offsets[1:-1])]
        placed = [np.column_stack([place(ring[:, 0], 0), place(ring[:, 1], 1)]) for ring in rings]
        return "".join("M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in ring) + "Z" for ring in placed)

    def ticks(axis: int) -> list[tuple[float, str]]:
        low, high = shown.low[axis], shown.high[axis]
        values = [value for value in MaxNLocator(5).tick_values(low, high) if low <= value <= high]
        return [(float(place(np.array(value), axis)), f"{value:.6g}") for value in values]

    left, right = place(np.array(box.low[0]), 0), place(np.array(box.high[0]), 0)
    top, bottom = place(np.array(box.high[1]), 1), place(np.array(box.low[1]), 1)
    return {
        "name": name,
        "labels": labels,
        "width": WIDTH,
        "height": height,
        "paths": {kind: path(level) for kind, level in levels.items()},
        "box": [f"{value:.1f}" for value in (left, top, right - left, bottom - top)],
        "ticks": [ticks(0), ticks(1) if height > STRIP else []],
    }
