"""Paths of the policy for a page: from starts where V is about 0.9, 0.5 and 0.1."""

from __future__ import annotations

from typing import Any

import torch

from pirl_rl.evaluation.inputs import like, noise_rng
from pirl_rl.evaluation.planes import planes_of
from pirl_rl.evaluation.rollouts import START_VALUES, Rollouts
from pirl_rl.evaluation.trajectories import Trajectories, closed_loop
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

EACH = 4
"""The number of paths from each start."""

MOST_POINTS = 120
"""The largest number of points of a path that are kept."""

LINE = 401
"""The number of states of a problem with one state among which starts are sought."""


def sample_paths(solution: Solution, simulator: Simulator) -> dict[str, Any]:
    """Paths on all planes, or over x where there is one state, with the times to go at their points.

    Returns:
        `starts`, V at the starts; `tau`, times to go (k,); `steps`, the place among them at which each path ends;
        `ends`, "reached", "failed" or "over"; and `points`, for each plane, or for the line, and each path the
        coordinates of its points.
    """
    problem = solution.problem
    if problem.states.dim == 1:
        paths, values = _line_paths(solution, simulator)
        coordinates = [paths.state]
    else:
        evidence = Rollouts(paths=EACH)(solution, simulator)
        assert evidence.paths is not None
        paths, values = evidence.paths, evidence.values
        coordinates = [plane.project(paths.state) for plane in planes_of(solution).values()]
    last = len(paths.tau) - 1
    kept = torch.linspace(0, last, min(last + 1, MOST_POINTS)).round().long()
    steps = torch.searchsorted(kept, paths.steps.cpu()).clamp(max=len(kept) - 1).tolist()
    ends = zip(paths.reached.tolist(), paths.failed.tolist(), strict=True)
    return {
        "starts": [round(value, 3) for value in values],
        "tau": [round(value, 6) for value in paths.tau[kept].amax(-1).tolist()],
        "steps": steps,
        "ends": ["reached" if reached else "failed" if failed else "over" for reached, failed in ends],
        "points": [[_short(entry[kept, i]) for i in range(len(steps))] for entry in coordinates],
    }


def _line_paths(solution: Solution, simulator: Simulator) -> tuple[Trajectories, list[float]]:
    problem = solution.problem
    x = torch.linspace(problem.states.low[0], problem.states.high[0], LINE, dtype=torch.float64).unsqueeze(-1)
    x = problem.states.wrap(x[problem.interior(x)])
    tau, x = like(solution, torch.full((len(x),), problem.horizon), x)
    value = solution.value(tau, x)
    starts = torch.stack([(value - level).abs().argmin() for level in START_VALUES])
    index = starts.repeat_interleave(EACH)
    paths = closed_loop(simulator, solution.policy, tau[index], x[index], noise_rng(solution, 0))
    return Trajectories(*(entry.cpu() for entry in vars(paths).values())), value[starts].tolist()


def _short(values: torch.Tensor) -> list[list[float]]:
    return [[float(f"{value:.4g}") for value in row] for row in values.tolist()]
