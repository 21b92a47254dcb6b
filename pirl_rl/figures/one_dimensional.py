"""Figures of the value and the policy of a one-dimensional problem over (tau, x)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from pirl_rl.problem import closed_form
from pirl_rl.solution import Solution

ERROR_RANGE = (1e-4, 1.0)
"""Ends of the logarithmic colour scale of absolute errors; on a linear one the corner at tau = 0 would hide the rest.
"""


class Grid(NamedTuple):
    """A solution of a one-dimensional problem on a grid of tau and x.

    Attributes:
        tau: times to go (taus,) in s.
        x: states (states,) in SI units.
        value: V (states, taus), which is 1 in A and 0 in B.
        exact: exact V (states, taus), or None if it is not known.
        control: the policy (controls, states, taus) in SI units.
    """

    tau: np.ndarray
    x: np.ndarray
    value: np.ndarray
    exact: np.ndarray | None
    control: np.ndarray


def evaluate_on_grid(solution: Solution, taus: int = 101, states: int = 201) -> Grid:
    """Compute V and the policy on [0, T] x `problem.states`, the grid of the paper's error."""
    problem = solution.problem
    tau = torch.linspace(0, problem.horizon, taus, dtype=torch.float64)
    x = torch.linspace(problem.states.low[0], problem.states.high[0], states, dtype=torch.float64)
    points = tau.repeat(states), problem.states.wrap(x.repeat_interleave(taus).unsqueeze(-1))
    exact = closed_form(problem, *points)
    inputs = [entry.to(solution.device, solution.dtype) for entry in points]
    shape = (states, taus)
    return Grid(
        tau.numpy(),
        x.numpy(),
        solution.value(*inputs).cpu().numpy().reshape(shape),
        None if exact is None else exact.numpy().reshape(shape),
        solution.policy(*inputs).cpu().numpy().T.reshape(-1, *shape),
    )


def draw_surface(grid: Grid) -> Figure:
    """A surface of V over (tau, x)."""
    figure = Figure(figsize=(5.6, 4.8), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    taus, states = np.meshgrid(grid.tau, grid.x)
    axes.plot_surface(taus, states, grid.value, cmap="viridis", vmin=0, vmax=1, rcount=60, ccount=60)  # type: ignore[attr-defined]
    axes.set(title="Value V(τ, x)", xlabel="time to go τ (s)", ylabel="state x (SI)")
    axes.set(zlabel="V", zlim=(0, 1))
    axes.view_init(elev=28, azim=-130)  # type: ignore[attr-defined]
    axes.set_box_aspect((4, 4, 3), zoom=0.95)  # type: ignore[arg-type]
    axes.locator_params(nbins=5)
    return figure


def draw_value(grid: Grid) -> Figure:
    """Heat maps of V and, if the exact V is known, of the exact V and the error."""
    unit = Normalize(0, 1)
    maps: list[tuple[str, np.ndarray, Normalize, str]] = [("V", grid.value, unit, "viridis")]
    if grid.exact is not None:
        error = np.abs(grid.value - grid.exact)
        mse = np.square(error).mean()
        maps += [
            ("Exact V", grid.exact, unit, "viridis"),
            (f"|error|, MSE {mse:.1e}", error.clip(ERROR_RANGE[0]), LogNorm(*ERROR_RANGE), "magma"),
        ]
    figure = Figure(figsize=(0.6 + 4.2 * len(maps), 3.8), layout="constrained")
    for axes, (title, values, scale, colors) in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps, strict=True):
        _heat_map(figure, axes, grid, values, scale, colors, title)
    return figure


def draw_policy(grid: Grid, solution: Solution) -> Figure:
    """Heat maps of the policy, one for each component of u, whose bounds are the ends of the colour scale."""
    controls = solution.problem.controls
    figure = Figure(figsize=(0.6 + 4.2 * controls.dim, 3.8), layout="constrained")
    for i, axes in enumerate(figure.subplots(1, controls.dim, squeeze=False)[0]):
        name = "Control u (SI)" if controls.dim == 1 else f"Control u{i + 1} (SI)"
        _heat_map(figure, axes, grid, grid.control[i], Normalize(controls.low[i], controls.high[i]), "coolwarm", name)
    return figure


def _heat_map(
    figure: Figure, axes: Axes, grid: Grid, values: np.ndarray, scale: Normalize, colors: str, title: str
) -> None:
    mesh = axes.pcolormesh(grid.tau, grid.x, values, cmap=colors, norm=scale, shading="gouraud")
    axes.set(title=title, xlabel="time to go τ (s)", ylabel="state x (SI)")
    figure.colorbar(mesh, ax=axes)
