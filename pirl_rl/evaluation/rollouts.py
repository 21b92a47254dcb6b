"""Stochastic closed-loop paths from three starts, for a figure in all planes; they have no metrics."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.inputs import noise_rng
from pirl_rl.evaluation.planes import planes_of
from pirl_rl.evaluation.slices import Section
from pirl_rl.evaluation.trajectories import Trajectories, closed_loop
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

START_VALUES = (0.9, 0.5, 0.1)
"""V at the starts, where paths should succeed almost always, half of the time, and hardly ever."""


@dataclass(frozen=True)
class RolloutsEvidence:
    """Paths of the policy, and V on all planes onto which they are projected.

    Attributes:
        sections: V on every plane; empty for a problem with one state.
        paths: equally many paths from each start, ordered by start, on the CPU; None for a problem with one state.
        values: V at the starts.
    """

    sections: list[Section]
    paths: Trajectories | None
    values: list[float]

    def metrics(self) -> dict[str, float]:
        return {}


class Rollouts:
    """Plays paths from those grid points of the first plane, outside A and B, where V is nearest to 0.9, 0.5 and 0.1.

    The paths start at the time to go of `Section.telling`, which is the horizon wherever V varies on the plane then.

    Args:
        paths: number of paths from each start.
        points: number of grid points of each plane along each axis, at least 2.
        seed: seed of the noise.

    Raises:
        ArgumentError: if there is no path, or fewer than two points.
    """

    def __init__(self, paths: int = 8, points: int = 31, seed: int = 0):
        if paths < 1 or points < 2:
            raise ArgumentError(f"Rollouts: expected paths >= 1 and points >= 2, got {paths} and {points}")
        self.paths, self.points, self.seed = paths, points, seed

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        return {}

    def __call__(self, solution: Solution, simulator: Simulator) -> RolloutsEvidence:
        problem = solution.problem
        planes = list(planes_of(solution).values())
        if not planes:
            return RolloutsEvidence([], None, [])
        first = Section.telling(solution, planes[0], self.points)
        others = [Section.of(solution, plane, self.points, first.time) for plane in planes[1:]]
        value = torch.where(problem.interior(first.x).cpu(), first.value.flatten(), torch.inf)
        starts = torch.stack([(value - level).abs().argmin() for level in START_VALUES])
        index = starts.repeat_interleave(self.paths).to(first.x.device)
        tau, x = first.tau[index], first.x[index]
        paths = closed_loop(simulator, solution.policy, tau, x, noise_rng(solution, self.seed))
        paths = Trajectories(*(entry.cpu() for entry in vars(paths).values()))
        return RolloutsEvidence([first, *others], paths, value[starts].tolist())
