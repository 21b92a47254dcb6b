"""A grid that is solved in seconds: a second opinion on a policy, and what holding a control costs."""

from __future__ import annotations

import numpy as np

from pirl_rl.errors import ArgumentError
from pirl_rl.grid.mesh import default_margin
from pirl_rl.grid.solution import GridSolution
from pirl_rl.grid.solver import GridSolver
from pirl_rl.problem import ReachAvoidProblem

NODES = {1: 201, 2: 81}
"""The number of nodes along each axis, by the number of states."""

BEYOND = 0.25
"""The largest margin beyond the box of states on each side, in widths of the box."""


def coarse_solution(problem: ReachAvoidProblem) -> GridSolution | None:
    """V and the policy on a coarse grid; None with more states than `NODES` has, and where no node meets the target."""
    states = problem.states
    if states.dim not in NODES:
        return None
    margin = np.minimum(default_margin(problem), BEYOND * (np.array(states.high) - np.array(states.low)))
    try:
        return GridSolver(problem, NODES[states.dim], margin=margin.tolist(), estimate=False).solve()
    except ArgumentError:
        return None
