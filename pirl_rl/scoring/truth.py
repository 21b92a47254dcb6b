"""Reference values of a problem at random states: exact, or those of the grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.grid import GridSolver
from pirl_rl.problem import ReachAvoidProblem, closed_form
from pirl_rl.sampling.initial_states import sample_interior

EARLIEST = 0.1
"""The smallest time to go, as a share of the horizon: below it V is nearly the payoff."""

GRID_POINTS = {1: 401, 2: 241, 3: 91}
"""Nodes of the grid along each axis, by the number of states."""

LARGEST = 4
"""The largest number of states and controls together for which the grid is solved.

With three states and two controls it would take half an hour and more than 8 GiB.
"""

DOUBT = 0.03
"""The grid is no truth at a state for which its estimate of its own error is larger: another state is taken there.

Such states lie where V jumps, as next to a corner of a set that the noise cannot reach from all sides.
"""

SPARE = 2
"""How many times as many states are drawn, so that there are others to take."""


@dataclass(frozen=True)
class Truth:
    """States with their reference values.

    Attributes:
        tau: times to go (N,), in s, uniform above a tenth of the horizon.
        x: states (N, n), uniform in the part of the box outside A and B, except those at which a grid is in doubt.
        value: V (N,), or None where neither a closed form nor a grid gives it.
        source: "exact", "grid" or "none".
        error: the mean of the grid's estimate of its own error, 0 for exact values.
    """

    tau: Tensor
    x: Tensor
    value: Tensor | None
    source: str
    error: float = 0.0


def find_truth(problem: ReachAvoidProblem, count: int, seed: int, points: Mapping[int, int] | None = None) -> Truth:
    """The reference values at `count` random states.

    The grid is solved for problems with at most `LARGEST` states and controls. States at which it is in doubt are left
    out. If too few of the drawn ones remain, or the target is too thin for the mesh, the grid is no truth at all.

    Args:
        problem: the physics.
        count: the number of states.
        seed: of the states and times to go.
        points: nodes of the grid along each axis, by the number of states; `GRID_POINTS` by default.
    """
    points = GRID_POINTS if points is None else points
    rng = torch.Generator().manual_seed(seed)
    x = sample_interior(problem, problem.states, SPARE * count, rng, torch.float64)
    tau = problem.horizon * (EARLIEST + (1 - EARLIEST) * torch.rand(len(x), generator=rng, dtype=x.dtype))
    exact = closed_form(problem, tau[:count], x[:count])
    if exact is not None:
        return Truth(tau[:count], x[:count], exact, "exact")
    if problem.states.dim not in points or problem.states.dim + problem.controls.dim > LARGEST:
        return Truth(tau[:count], x[:count], None, "none")
    solver = GridSolver(problem, points[problem.states.dim])
    if not solver.resolves_target:
        return Truth(tau[:count], x[:count], None, "none")
    grid = solver.solve()
    error = grid.error(tau, x)
    kept = (error <= DOUBT).nonzero().flatten()[:count]
    if len(kept) < count:
        return Truth(tau[:count], x[:count], None, "none")
    return Truth(tau[kept], x[kept], grid.value(tau[kept], x[kept]), "grid", error[kept].mean().item())
