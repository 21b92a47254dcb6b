"""Stochastic closed-loop paths from three starts, to be seen in all planes; they have no metrics."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.inputs import noise_rng
from pirl_rl.evaluation.slices import Section
from pirl_rl.evaluation.trajectories import Trajectories, closed_loop
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

LEVELS = (0.9, 0.5, 0.1)
"""V at the starts: of paths that should succeed, that may, and that should not."""


@dataclass(frozen=True)
class RolloutsEvidence:
    """Paths of the policy, and V on all planes into which they are projected.

    Attributes:
        sections: V on every plane; empty for a problem without planes.
        paths: on the CPU, those from one start side by side, as many from each; None without planes.
        values: V at the starts.
    """

    sections: list[Section]
    paths: Trajectories | None
    values: list[float]

    def metrics(self) -> dict[str, float]:
        return {}


class Rollouts:
    """Paths over the whole horizon from the states of the first plane's grid, outside A and B, where V is nearest to
    0.9, 0.5 and 0.1.

    Args:
        paths: from each start.
        points: of the planes' grids along each axis.
        seed: of the noise.
    """

    def __init__(self, paths: int = 8, points: int = 31, seed: int = 0):
        if paths < 1 or points < 2:
            raise ArgumentError(f"Rollouts: expected paths >= 1 and points >= 2, got {paths} and {points}")
        self.paths, self.points, self.seed = paths, points, seed

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        return {}

    def __call__(self, solution: Solution, simulator: Simulator) -> RolloutsEvidence:
        problem = solution.problem
        sections = [Section.of(solution, plane, self.points) for plane in problem.planes.values()]
        if not sections:
            return RolloutsEvidence([], None, [])
        first = sections[0]
        value = torch.where(problem.interior(first.x).cpu(), first.value.flatten(), torch.inf)
        starts = torch.stack([(value - level).abs().argmin() for level in LEVELS])
        index = starts.repeat_interleave(self.paths).to(first.x.device)
        tau, x = first.tau[index], first.x[index]
        paths = closed_loop(simulator, solution.policy, tau, x, noise_rng(solution, self.seed))
        paths = Trajectories(*(entry.cpu() for entry in vars(paths).values()))
        return RolloutsEvidence(sections, paths, value[starts].tolist())
