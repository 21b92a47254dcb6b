"""Figures of a run: the learned value, its error, the policy, and the course of training.

Figures are drawn without pyplot, so that no display and no global state is needed.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from pirl_rl.evaluation import Evaluator, draw_evidence
from pirl_rl.files import replacing
from pirl_rl.solution import Solution

TRAINING = {"train_td_loss": "TD", "train_hjb_loss": "HJB", "train_boundary_loss": "boundary"}
HELD_OUT = {
    "td_loss": "TD",
    "hjb_loss": "HJB",
    "boundary_loss": "boundary",
    "hjb_sup_loss": "HJB, sup over u",
    "value_mse": "MSE of V",
}
WEIGHTS = {"td_weight": "TD", "hjb_weight": "HJB", "boundary_weight": "boundary"}
STYLES = {"TD": "C0-", "HJB": "C1-", "boundary": "C2--", "HJB, sup over u": "C3--", "MSE of V": "C4-"}
DPI = 110
ERRORS = (1e-4, 1.0)
"""Colour scale of absolute errors, logarithmic: the corner would else hide all others."""


class Grid(NamedTuple):
    """A solution on tau x state, for one-dimensional problems; arrays (states, taus), `exact` where it is known."""

    tau: np.ndarray
    x: np.ndarray
    value: np.ndarray
    exact: np.ndarray | None
    control: np.ndarray  # (controls, states, taus)


def draw_run(
    solution: Solution, metrics_path: str | Path, folder: str | Path, evaluators: Iterable[Evaluator] = ()
) -> list[Path]:
    """Draw a run's figures into `folder`: training curves, in one dimension surface, heat maps and policy, and what the
    evaluators measured last.

    Args:
        metrics_path: the run's metrics.csv; without one there are no training curves.
        evaluators: those that have been called with the solution.

    Returns:
        The files written.
    """
    figures = {"training": draw_training(read_metrics(metrics_path))} if Path(metrics_path).is_file() else {}
    if solution.problem.states.dim == 1:
        grid = solve_on_grid(solution)
        figures |= {"surface": draw_surface(grid), "value": draw_value(grid), "policy": draw_policy(grid, solution)}
    return save_figures(figures | draw_evidence(evaluators), folder)


def save_figures(figures: Mapping[str, Figure], folder: str | Path) -> list[Path]:
    """Write figures as PNG files of their names; returns the files."""
    paths = [Path(folder) / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        with replacing(path, binary=True) as file:
            figure.savefig(file, dpi=DPI, format="png", pil_kwargs={"optimize": True})
    return paths


def read_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """Columns of a metrics.csv as float arrays (rows,), NaN where a cell is empty."""
    with open(path, newline="") as file:
        rows = csv.DictReader(file)
        names, cells = rows.fieldnames or [], list(rows)
    return {name: np.array([float(row[name] or "nan") for row in cells]) for name in names}


def solve_on_grid(solution: Solution, taus: int = 101, states: int = 201) -> Grid:
    """The raw value and the policy on [0, T] x `problem.states`: the paper's error grid."""
    problem = solution.problem
    tau = torch.linspace(0, problem.horizon, taus, dtype=torch.float64)
    x = torch.linspace(problem.states.low[0], problem.states.high[0], states, dtype=torch.float64)
    points = tau.repeat(states), x.repeat_interleave(taus).unsqueeze(-1)
    exact = problem.exact_value(*points)
    inputs = [entry.to(solution.device, solution.dtype) for entry in points]
    shape = (states, taus)
    return Grid(
        tau.numpy(),
        x.numpy(),
        solution.raw_value(*inputs).cpu().numpy().reshape(shape),
        None if exact is None else exact.numpy().reshape(shape),
        solution.policy(*inputs).cpu().numpy().T.reshape(-1, *shape),
    )


def draw_surface(grid: Grid) -> Figure:
    """The learned V over (tau, x)."""
    figure = Figure(figsize=(5.6, 4.8), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    taus, states = np.meshgrid(grid.tau, grid.x)
    axes.plot_surface(taus, states, grid.value, cmap="viridis", vmin=0, vmax=1, rcount=60, ccount=60)  # type: ignore[attr-defined]
    axes.set(title="Learned value V(τ, x)", xlabel="time to go τ (s)", ylabel="state x (SI)")
    axes.set(zlabel="V", zlim=(0, 1))
    axes.view_init(elev=28, azim=-130)  # type: ignore[attr-defined]
    axes.set_box_aspect((4, 4, 3), zoom=0.95)  # type: ignore[arg-type]
    axes.locator_params(nbins=5)
    return figure


def draw_value(grid: Grid) -> Figure:
    """Heat maps of the learned V and, where it is known, of the exact V and of the error."""
    unit = Normalize(0, 1)
    maps: list[tuple[str, np.ndarray, Normalize, str]] = [("Learned V", grid.value, unit, "viridis")]
    if grid.exact is not None:
        error = np.abs(grid.value - grid.exact)
        mse = np.square(error).mean()
        maps += [
            ("Exact V", grid.exact, unit, "viridis"),
            (f"|error|, MSE {mse:.1e}", error.clip(ERRORS[0]), LogNorm(*ERRORS), "magma"),
        ]
    figure = Figure(figsize=(0.6 + 4.2 * len(maps), 3.8), layout="constrained")
    for axes, (title, values, scale, colors) in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps, strict=True):
        _heat_map(figure, axes, grid, values, scale, colors, title)
    return figure


def draw_policy(grid: Grid, solution: Solution) -> Figure:
    """Heat maps of the policy, one for each component of u, on the scale of its bounds."""
    controls = solution.problem.controls
    figure = Figure(figsize=(0.6 + 4.2 * controls.dim, 3.8), layout="constrained")
    for i, axes in enumerate(figure.subplots(1, controls.dim, squeeze=False)[0]):
        name = "Learned control u (SI)" if controls.dim == 1 else f"Learned control u{i + 1} (SI)"
        _heat_map(figure, axes, grid, grid.control[i], Normalize(controls.low[i], controls.high[i]), "coolwarm", name)
    return figure


def draw_training(metrics: dict[str, np.ndarray]) -> Figure:
    """Training losses, held-out losses and loss weights over updates."""
    figure = Figure(figsize=(7, 8), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    _curves(top, metrics, TRAINING, "Training losses, summed over critics")
    _curves(middle, metrics, HELD_OUT, "Held-out losses", marker=".")
    _curves(bottom, metrics, WEIGHTS, "Loss weights")
    for axes in (top, middle):
        axes.set_ylabel("loss")
        log_scale(axes, "y", [value for line in axes.lines for value in line.get_ydata()])  # type: ignore[union-attr]
    bottom.set(xlabel="update", ylabel="weight")
    bottom.set_ylim(bottom=0)
    if "stage" in metrics:
        for update in metrics["update"][1:][np.diff(metrics["stage"]) != 0]:
            for axes in (top, middle, bottom):
                axes.axvline(update, color="0.4", ls=":")
        bottom.set_xlabel("update; dotted: a stage begins")
    return figure


def log_scale(axes: Axes, axis: Literal["x", "y"], values: Sequence[float]) -> None:
    """A logarithmic axis; where no value is positive, which such an axis refuses, a word instead."""
    if any(value > 0 for value in values):
        axes.set(**{f"{axis}scale": "log"})
    else:
        axes.text(0.5, 0.5, "not available", ha="center", va="center", transform=axes.transAxes)


def _heat_map(
    figure: Figure, axes: Axes, grid: Grid, values: np.ndarray, scale: Normalize, colors: str, title: str
) -> None:
    mesh = axes.pcolormesh(grid.tau, grid.x, values, cmap=colors, norm=scale, shading="gouraud")
    axes.set(title=title, xlabel="time to go τ (s)", ylabel="state x (SI)")
    figure.colorbar(mesh, ax=axes)


def _curves(axes: Axes, metrics: dict[str, np.ndarray], names: dict[str, str], title: str, marker: str = "") -> None:
    for name, label in names.items():
        if name in metrics and np.isfinite(metrics[name]).any():
            known = np.isfinite(metrics[name])
            axes.plot(metrics["update"][known], metrics[name][known], STYLES[label], marker=marker, label=label)
    axes.set_title(title)
    axes.grid(alpha=0.3)
    if axes.lines:
        axes.legend(fontsize="small")
