"""Checks of what a problem says about its own solution: the exact value, an optimal control, planes for figures."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from pirl_rl.checking.findings import Finding, found
from pirl_rl.checking.samples import Samples, defines
from pirl_rl.problem import closed_form

ROUNDING = 1e-4
"""Deviations of probabilities that count as rounding, also of a series in single precision."""


def exact_value(samples: Samples) -> Iterator[Finding]:
    """The exact value must be a probability, and the payoff where the time to go is 0."""
    problem, x = samples.problem, samples.x
    if not defines(problem, "exact_value"):
        return
    x = x[problem.interior(x)]
    for tau in (0.0, problem.horizon / 3, problem.horizon):
        times = torch.full((len(x),), tau, dtype=x.dtype)
        value = closed_form(problem, times, x)
        if value is None:
            return
        if value.shape != times.shape:
            message = f"expected shape {tuple(times.shape)}, got {tuple(value.shape)}."
            yield found(problem, "error", "exact_value", message)
            return
        wrong = ~((value >= -ROUNDING) & (value <= 1 + ROUNDING))
        expected = "a probability"
        if tau == 0.0:
            wrong, expected = wrong | ((value - problem.boundary_value(x)).abs() > ROUNDING), "the payoff"
        if wrong.any():
            message = f"expected {expected} at tau = {tau:g}, got {float(value[wrong][0]):.6g}."
            yield found(problem, "error", "exact_value", message, x[wrong][0])
            return


def optimal_control(samples: Samples) -> Iterator[Finding]:
    """An optimal control must lie in the box of controls."""
    problem, x = samples.problem, samples.x
    if not defines(problem, "optimal_control"):
        return
    u = problem.optimal_control(torch.full((len(x),), problem.horizon, dtype=x.dtype), x)
    if u is None:
        return
    if u.shape != samples.u.shape:
        message = f"expected shape {tuple(samples.u.shape)}, got {tuple(u.shape)}."
        yield found(problem, "error", "optimal_control", message)
        return
    outside = ~((problem.controls.normalize(u).abs() <= 1 + ROUNDING).all(-1))
    if outside.any():
        message = f"expected controls in {problem.controls}, got {u[outside][0].tolist()}."
        yield found(problem, "error", "optimal_control", message, x[outside][0])


def planes(samples: Samples) -> Iterator[Finding]:
    """A plane must embed its points as states."""
    problem = samples.problem
    for name, plane in problem.planes.items():
        points = plane.box.sample(4, torch.Generator().manual_seed(0), torch.float64)
        try:
            states = plane.embed(points)
            back = plane.project(states)
            fits = states.shape == (4, problem.states.dim) and back.shape == points.shape
            outcome = f"states of shape {tuple(states.shape)} and points of shape {tuple(back.shape)}"
        except Exception as error:
            fits, outcome = False, f"{type(error).__name__}: {error}"
        if not fits:
            message = (
                f"expected the plane {name!r} to map points (4, 2) to states (4, {problem.states.dim}) and back, got "
                f"{outcome}."
            )
            yield found(problem, "error", "planes", message)
