"""V in cells that a face of A or B cuts, where the noise is weak beside the mesh.

There V rises from the face within a layer that is thinner than a cell, so that interpolation between the nodes is
wrong. A path along the flow, without noise, leads out of these cells; the noise decides whether it crosses the face.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pirl_rl.crossings import passage_probability
from pirl_rl.problem import ReachAvoidProblem

STEPS_OF_A_CELL = 8
"""The number of steps in which a path is followed through a cell."""

MOST_CELLS = 8
"""The largest number of cells through which a path is followed."""


def beyond_the_face(
    problem: ReachAvoidProblem,
    spacing: Tensor,
    policy: Callable[[Tensor, Tensor], Tensor],
    value: Callable[[Tensor, Tensor], Tensor],
    cut: Callable[[Tensor], Tensor],
    tau: Tensor,
    x: Tensor,
) -> Tensor:
    """V (P,) at states outside A and B in cells that a face cuts, from that where the flow has left these cells.

    A path is followed cell by cell, through at most `MOST_CELLS` of them. On the way the noise may cross a face. In
    each cell its level is taken as Brownian motion with the drift of the way through the cell, see
    `pirl_rl.crossings.passage_probability`. Paths that cross a face of A and one of B count as failures.

    Args:
        problem: the physics.
        spacing: the distances (n,) of the nodes, in SI units.
        policy: gives the controls, in SI units, at tau and x.
        value: gives V between the nodes, continued into A and B, at tau and x.
        cut: says which states x lie in a cell that a face cuts.
        tau: times to go (P,), in s.
        x: states (P, n), in SI units.
    """
    x, left = x.clone(), tau.to(x, copy=True)
    under_way, result = torch.ones_like(left), torch.zeros_like(left)
    going = torch.arange(len(x), device=x.device)
    for _ in range(MOST_CELLS):
        moved, after, reached, failed = _through_a_cell(problem, spacing, policy, left[going], x[going])
        x[going], left[going] = moved, after
        result[going] += under_way[going] * reached
        under_way[going] *= (1 - reached - failed).clamp(min=0)
        going = going[cut(moved) & problem.interior(moved) & (after > 0)]
        if not len(going):
            break
    return result + under_way * value(left, x)


def _through_a_cell(
    problem: ReachAvoidProblem, spacing: Tensor, policy: Callable[[Tensor, Tensor], Tensor], tau: Tensor, x: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where the flow from x (P, n) is one cell further, the time to go there, and the probabilities, each (P,), that
    the noise has crossed into A or B on the way."""
    u = policy(tau, x)
    rate = problem.drift(x, u).abs() / spacing
    length = torch.minimum(tau, 1 / rate.amax(-1).clamp(min=1e-12))
    moved, left, h = x, tau, length / STEPS_OF_A_CELL
    for _ in range(STEPS_OF_A_CELL):
        moved = problem.states.wrap(moved + problem.drift(moved, policy(left, moved)) * h.unsqueeze(-1))
        left = (left - h).clamp(min=0)
    sigma, reached, failed = problem.diffusion(x, u), torch.zeros_like(tau), torch.zeros_like(tau)
    if problem.has_avoid_set:
        # One constraint of B suffices, and all of A must hold.
        failed = 1 - (1 - passage_probability(problem.avoid_constraints, x, moved, sigma, length)).prod(-1)
    if problem.objective == "reach-avoid":
        crossed = passage_probability(problem.reached_constraints, x, moved, sigma, length).amin(-1)
        reached = (1 - failed) * crossed
    return moved, left, reached, failed
