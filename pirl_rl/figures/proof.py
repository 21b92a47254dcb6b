"""The map of what is proved: a proved lower bound of the probability of success beside V."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from pirl_rl.evaluation.inputs import like
from pirl_rl.evaluation.planes import planes_of
from pirl_rl.evaluation.slices import Section
from pirl_rl.figures.planes import CONTOURS, draw_sets
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs import Proof
from pirl_rl.solution import Solution

POINTS = 161
"""The number of points along each axis."""


def draw_proof(solution: Solution, proof: Proof) -> dict[str, Figure]:
    """Figures of a bound at tau = T by name: a curve for one state, maps on the planes of the solution for more."""
    if solution.problem.states.dim == 1:
        return {"proof": _curve(solution, proof)}
    horizon = solution.problem.horizon
    sections = {name: Section.of(solution, plane, POINTS, horizon) for name, plane in planes_of(solution).items()}
    return {f"proof_{name}": _map(solution, proof, section) for name, section in sections.items()}


def _curve(solution: Solution, proof: Proof) -> Figure:
    problem = solution.problem
    x = torch.linspace(problem.states.low[0], problem.states.high[0], POINTS, dtype=torch.float64).unsqueeze(-1)
    tau = torch.full((POINTS,), problem.horizon, dtype=torch.float64)
    value = solution.value(*like(solution, tau, x))
    figure = Figure(figsize=(5.6, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(x[:, 0], value.cpu(), label="learned V")
    exact = problem.exact_value(tau, x)
    if exact is not None:
        axes.plot(x[:, 0], exact, "k--", linewidth=1, label="exact V")
    axes.fill_between(x[:, 0], 0, _bound(problem, proof, tau, x), alpha=0.3, color="tab:green", label="proved")
    axes.set(title=f"Proved success, τ = {problem.horizon:g} s", xlabel="state x (SI)", ylabel="probability")
    axes.set(ylim=(0, 1.02))
    axes.legend()
    return figure


def _map(solution: Solution, proof: Proof, section: Section) -> Figure:
    bound = _bound(solution.problem, proof, section.tau.cpu().double(), section.x.cpu().double())
    bound = bound.reshape(section.value.shape)
    first, second = (axis.numpy() for axis in section.axes)
    figure = Figure(figsize=(10.4, 4.4), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    titles = (f"Proved success, τ = {section.time:g} s", f"Learned V, τ = {section.time:g} s")
    for axes, title, values in zip(panels, titles, (bound, section.value.numpy()), strict=True):
        mesh = axes.pcolormesh(first, second, values, cmap="viridis", vmin=0, vmax=1, shading="nearest")
        axes.clabel(axes.contour(first, second, values, CONTOURS, colors="white", linewidths=1), fontsize="x-small")
        draw_sets(axes, section)
        axes.set(title=title, xlabel=section.plane.axes[0], ylabel=section.plane.axes[1])
    figure.colorbar(mesh, ax=list(panels), label="probability")
    return figure


def _bound(problem: ReachAvoidProblem, proof: Proof, tau: Tensor, x: Tensor) -> np.ndarray:
    """The bound (N,), 1 in A and 0 in B and outside the box, since paths that leave it count as failures."""
    inside, bound = problem.states.contains(x) & problem.interior(x), np.zeros(len(x))
    bound[inside.numpy()] = proof.bound(tau[inside].numpy(), x[inside].numpy())
    if problem.objective == "reach-avoid":
        bound[problem.reached(x).numpy()] = 1
    return bound
