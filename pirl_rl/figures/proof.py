"""The map of what is proved: bounds of the probability of success, from below and from above, beside V."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from pirl_rl.evaluation.inputs import like
from pirl_rl.evaluation.planes import planes_of
from pirl_rl.evaluation.slices import Section
from pirl_rl.figures.planes import CONTOURS, draw_sets
from pirl_rl.problem import closed_form
from pirl_rl.proofs import LowerBound, UpperBound
from pirl_rl.solution import Solution

POINTS = 161
"""The number of points along each axis."""

Bound = LowerBound | UpperBound


def draw_proof(solution: Solution, bounds: Sequence[Bound]) -> dict[str, Figure]:
    """Figures of bounds at tau = T by name: a curve for one state, maps on the planes of the solution for more."""
    if solution.problem.states.dim == 1:
        return {"proof": _curve(solution, bounds)}
    horizon = solution.problem.horizon
    sections = {name: Section.of(solution, plane, POINTS, horizon) for name, plane in planes_of(solution).items()}
    return {f"proof_{name}": _map(solution, bounds, section) for name, section in sections.items()}


def _curve(solution: Solution, bounds: Sequence[Bound]) -> Figure:
    problem = solution.problem
    x = torch.linspace(problem.states.low[0], problem.states.high[0], POINTS, dtype=torch.float64).unsqueeze(-1)
    tau = torch.full((POINTS,), problem.horizon, dtype=torch.float64)
    value = solution.value(*like(solution, tau, x))
    figure = Figure(figsize=(5.6, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(x[:, 0], value.cpu(), label="learned V")
    exact = closed_form(problem, tau, x)
    if exact is not None:
        axes.plot(x[:, 0], exact, "k--", linewidth=1, label="exact V")
    for bound in bounds:
        values, lower = _values(bound, tau, x), isinstance(bound, LowerBound)
        style = ("tab:green", "proved of the policy") if lower else ("tab:red", "out of reach of all policies")
        axes.fill_between(x[:, 0], 0 if lower else 1, values, alpha=0.3, color=style[0], label=style[1])
    axes.set(title=f"Proved success, τ = {problem.horizon:g} s", xlabel="state x (SI)", ylabel="probability")
    axes.set(ylim=(0, 1.02))
    axes.legend()
    return figure


def _map(solution: Solution, bounds: Sequence[Bound], section: Section) -> Figure:
    first, second = (axis.numpy() for axis in section.axes)
    shown = {"Learned V": section.value.numpy()}
    for bound in bounds:
        values = _values(bound, section.tau.cpu().double(), section.x.cpu().double())
        name = "Proved success" if isinstance(bound, LowerBound) else "No policy succeeds with more"
        shown[name] = values.reshape(section.value.shape)
    # What is proved from below stands left of V, and what is proved from above right of it.
    order = [name for name in ("Proved success", "Learned V", "No policy succeeds with more") if name in shown]
    figure = Figure(figsize=(5.2 * len(order), 4.4), layout="constrained")
    panels = figure.subplots(1, len(order), sharex=True, sharey=True)
    for axes, name in zip(panels, order, strict=True):
        values = shown[name]
        mesh = axes.pcolormesh(first, second, values, cmap="viridis", vmin=0, vmax=1, shading="nearest")
        axes.clabel(axes.contour(first, second, values, CONTOURS, colors="white", linewidths=1), fontsize="x-small")
        draw_sets(axes, section)
        axes.set(title=f"{name}, τ = {section.time:g} s", xlabel=section.plane.axes[0], ylabel=section.plane.axes[1])
    figure.colorbar(mesh, ax=list(panels), label="probability")
    return figure


def _values(bound: Bound, tau: Tensor, x: Tensor) -> np.ndarray:
    """The bound (N,), 1 in A and 0 in B, and outside the box what is known without a proof."""
    problem = bound.problem
    values = np.full(len(x), 0.0 if isinstance(bound, LowerBound) else 1.0)
    inside = problem.states.contains(x) & problem.interior(x)
    values[inside.numpy()] = bound.bound(tau[inside].numpy(), x[inside].numpy())
    values[problem.reached(x).numpy()] = 1
    values[problem.failed(x).numpy()] = 0
    return values
