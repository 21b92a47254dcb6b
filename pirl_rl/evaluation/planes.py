"""The planes of the state space in which a solution is shown: those of the problem, or else planes of coordinates."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pirl_rl.errors import ProblemError
from pirl_rl.evaluation.inputs import like
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.faces import find_faces
from pirl_rl.sets import Box, Plane
from pirl_rl.solution import Solution

STATES = 1_024
"""The number of random states at which the slopes of V are compared."""


def plane_names(problem: ReachAvoidProblem) -> tuple[str, ...]:
    """The names of the planes of `planes_of`."""
    if problem.planes:
        return tuple(problem.planes)
    n = problem.states.dim
    return () if n == 1 else ("states",) if n == 2 else ("first", "steepest")


def planes_of(solution: Solution) -> Mapping[str, Plane]:
    """The problem's planes; where it has none, those of pairs of coordinates, for two or more states.

    With two states it is the plane of both. With more there are two planes through the point of the target that is
    nearest to the centre of the box, or through the centre where there is no target: "first" of the first two
    coordinates, and "steepest" of the other pair in which V varies most, by its mean slope over the box at tau = T.
    """
    problem, names = solution.problem, plane_names(solution.problem)
    if problem.planes or not names:
        return problem.planes
    base, pairs = _base(problem), [(0, 1)]
    if len(names) > 1:
        pairs.append(_steepest(solution))
    return {name: coordinate_plane(problem, *pair, base) for name, pair in zip(names, pairs, strict=True)}


def coordinate_plane(problem: ReachAvoidProblem, first: int, second: int, base: Tensor) -> Plane:
    """The plane of two coordinates, counted from 0, through a state (n,)."""
    states, pair = problem.states, [first, second]
    periodic = [axis for axis, coordinate in enumerate(pair) if coordinate in states.periodic]

    def embed(points: Tensor) -> Tensor:
        x = base.to(points).expand(*points.shape[:-1], -1).clone()
        x[..., pair] = points
        return x

    box = Box([states.low[i] for i in pair], [states.high[i] for i in pair], periodic)
    names = problem.state_names or [f"$x_{{{i + 1}}}$" for i in range(states.dim)]
    return Plane((names[first], names[second]), box, embed, lambda x: x[..., pair])


def slopes_of(solution: Solution) -> Tensor:
    """The mean of |dV/dx_i| (n,) over the box at tau = T, with each coordinate in units of half of its width."""
    problem = solution.problem
    x = problem.states.sample(STATES, torch.Generator().manual_seed(0), torch.float64)
    x = x[problem.interior(x)]
    tau, x = like(solution, torch.full((len(x),), problem.horizon), x)
    slope = solution.gradient(tau, x) * problem.states.center_and_half_width(x)[1]
    return slope.abs().mean(0)


def _base(problem: ReachAvoidProblem) -> Tensor:
    """The point (n,) of the target that is nearest to the centre of the box, or that centre."""
    centre = problem.states.center_and_half_width(torch.zeros(1, dtype=torch.float64))[0]
    if problem.objective == "invariance":
        return centre
    rng = torch.Generator().manual_seed(0)
    inside = problem.states.sample(STATES, rng, torch.float64)
    try:
        faces = find_faces(problem, rng)
        inside = torch.cat([inside, faces.points[faces.values > 0.5].double()])
    except ProblemError:  # the checker names sets that are not found; the figures do without them
        pass
    inside = torch.cat([centre.unsqueeze(0), inside])
    inside = inside[problem.reached(inside) & problem.states.contains(inside)]
    return inside[problem.states.normalize(inside).norm(dim=-1).argmin()] if len(inside) else centre


def _steepest(solution: Solution) -> tuple[int, int]:
    """The pair of coordinates, other than the first two, with the largest mean slopes of V across the box."""
    order = slopes_of(solution).argsort(descending=True).tolist()
    pair = order[:2] if {*order[:2]} != {0, 1} else [order[0], order[2]]
    return min(pair), max(pair)
