"""V and the policy on tensor grids, for the sliders of a page.

A plane has one slider for tau. Further coordinates, which are constant on the plane, have one each, and move one at a
time: a tensor over all of them would have too many points. With three states there is one further coordinate, so
that the tensor is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from pirl_rl.evaluation.inputs import like
from pirl_rl.evaluation.planes import slopes_of
from pirl_rl.evaluation.slices import Section
from pirl_rl.reports.names import as_html, control_names, split_unit, state_names
from pirl_rl.reports.outlines import equal_scales, levels_of
from pirl_rl.reports.packing import packed, quantised
from pirl_rl.sets import Plane
from pirl_rl.solution import Solution

CHUNK = 2**15
"""The number of points at which networks are evaluated at once."""

LEVELS = 0.1
"""The part of the largest level up to which a level is told; lines of the level 0 need those around it alone."""

MOST_SLIDERS = 5
"""The largest number of further coordinates with a slider; those in which V varies most have one."""

MOST_CONTROLS = 3
"""The largest number of components of the control that are shown."""

SAMPLES = 31
"""The number of points along each axis of the section whose time to go is shown first."""


class Resolution(NamedTuple):
    """The numbers of points along each axis of a plane, of times to go, and of values of each further coordinate."""

    side: int
    taus: int
    levels: int


RESOLUTIONS = (
    *(Resolution(81, 25, 25), Resolution(61, 21, 21), Resolution(51, 17, 15), Resolution(41, 13, 11)),
    *(Resolution(35, 11, 9), Resolution(31, 9, 7), Resolution(25, 8, 5), Resolution(21, 6, 5)),
)
"""The resolutions that are tried, from the finest down."""


def plane_maps(solution: Solution, planes: Mapping[str, Plane], bytes_in_all: int) -> list[dict[str, Any]]:
    """V and the policy on planes, in the finest resolution that takes at most so many bytes before compression."""
    sliders = {name: _sliders(solution, plane) for name, plane in planes.items()}
    layers = 1 + min(solution.problem.controls.dim, MOST_CONTROLS)

    def size(resolution: Resolution) -> int:
        points = resolution.side**2 * resolution.taus * layers
        return sum(points * max(1, len(found) * resolution.levels) for found in sliders.values())

    resolution = next((entry for entry in RESOLUTIONS if size(entry) <= bytes_in_all), RESOLUTIONS[-1])
    return [_plane_map(solution, name, plane, sliders[name], resolution) for name, plane in planes.items()]


def _sliders(solution: Solution, plane: Plane) -> list[int]:
    """The coordinates that are constant on a plane, at most `MOST_SLIDERS`, in their order."""
    rng = torch.Generator().manual_seed(0)
    x = plane.embed(plane.box.sample(64, rng, torch.float64))
    constant = ((x - x[0]).abs().amax(0) == 0).nonzero().flatten().tolist()
    if len(constant) <= MOST_SLIDERS:
        return constant
    slope = slopes_of(solution).tolist()
    return sorted(sorted(constant, key=lambda i: -slope[i])[:MOST_SLIDERS])


def _plane_map(
    solution: Solution, name: str, plane: Plane, sliders: list[int], resolution: Resolution
) -> dict[str, Any]:
    problem, side = solution.problem, resolution.side
    names = state_names(problem)
    axes = [torch.linspace(a, b, side, dtype=torch.float64) for a, b in zip(plane.box.low, plane.box.high, strict=True)]
    grid = plane.embed(torch.stack(torch.meshgrid(*axes, indexing="xy"), -1).reshape(-1, 2))
    constant = [i for i in range(problem.states.dim) if bool((grid[:, i] == grid[0, i]).all())]
    taus = [problem.horizon * ((k + 1) / resolution.taus) ** 2 for k in range(resolution.taus)]
    further, layers = [], []
    for i in sliders:
        values, start = _levels(problem.states, i, float(grid[0, i]), resolution.levels)
        further.append({"label": as_html(names[i]), "values": values, "start": start})
        layers.append(_layers(solution, taus, [_moved(grid, i, value) for value in values]))
    return {
        "name": name,
        "labels": [as_html(label) for label in plane.axes],
        "low": list(plane.box.low),
        "high": list(plane.box.high),
        "periodic": [axis in plane.box.periodic for axis in (0, 1)],
        "equal": equal_scales(plane),
        "side": side,
        "taus": taus,
        "start": _nearest(taus, Section.telling(solution, plane, SAMPLES).time),
        "further": further,
        "fixed": [[as_html(names[i]), f"{float(grid[0, i]):.4g}"] for i in constant],
        "left_out": len(constant) - len(sliders),
        "layers": layers or [_layers(solution, taus, [grid])],
    }


def _levels(box, i: int, base: float, count: int) -> tuple[list[float], int]:
    """Values of a coordinate across the box, the one of the plane among them, and its place."""
    low, high = box.low[i], box.high[i]
    values = np.linspace(low, high, count, endpoint=i not in box.periodic).tolist()
    if min(abs(value - base) for value in values) < 1e-9 * (high - low):
        values = [base if abs(value - base) < 1e-9 * (high - low) else value for value in values]
    else:
        values = sorted([*values, base])
    return values, values.index(base)


def _moved(grid: Tensor, i: int, value: float) -> Tensor:
    x = grid.clone()
    x[:, i] = value
    return x


def _nearest(values: list[float], wanted: float) -> int:
    return min(range(len(values)), key=lambda k: abs(values[k] - wanted))


def _layers(solution: Solution, taus: list[float], grids: list[Tensor]) -> dict[str, Any]:
    """V and the control over times to go, grids of states, and the points of a grid, in this order, packed.

    The levels of the sets, which tau does not change, are over grids and points.
    """
    problem = solution.problem
    x = problem.states.wrap(torch.cat(grids))
    levels = levels_of(problem, x)
    tau = torch.tensor(taus, dtype=torch.float64).repeat_interleave(len(x))
    x = x.repeat(len(taus), 1)
    value = evaluated(solution, solution.value, tau, x)
    control, box = evaluated(solution, solution.policy, tau, x), problem.controls
    shown = range(min(box.dim, MOST_CONTROLS))
    return {
        "value": packed(quantised(value, 0.0, 1.0, 255)),
        "control": [packed(quantised(control[:, j], box.low[j], box.high[j], 255)) for j in shown],
        "sets": {name: packed(_signed(level)) for name, level in levels.items()},
    }


def _signed(level: Tensor) -> np.ndarray:
    """Levels (N,) as integers, at most 127 inside the set and at least 128 outside."""
    scale = LEVELS * float(level.abs().max()) or 1.0
    codes = quantised((level / scale).numpy(), -1.0, 1.0, 255)
    return np.where((level <= 0).numpy(), np.minimum(codes, 127), np.maximum(codes, 128)).astype(np.uint8)


def evaluated(solution: Solution, function: Callable[[Tensor, Tensor], Tensor], tau: Tensor, x: Tensor) -> np.ndarray:
    """A function of a solution at times to go (N,) and states (N, n), some points at a time."""
    parts = [function(*like(solution, *part)) for part in zip(tau.split(CHUNK), x.split(CHUNK), strict=True)]
    return torch.cat(parts).double().cpu().numpy()


def shown_controls(solution: Solution) -> list[dict[str, Any]]:
    """Names and ranges of the components of the control that are shown."""
    box = solution.problem.controls
    names = [split_unit(name) for name in control_names(solution.problem)[:MOST_CONTROLS]]
    return [
        {"label": as_html(symbol), "unit": as_html(unit), "low": box.low[j], "high": box.high[j]}
        for j, (symbol, unit) in enumerate(names)
    ]
