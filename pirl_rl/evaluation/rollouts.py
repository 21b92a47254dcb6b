"""Stochastic closed-loop paths from three starts, seen in all planes: a figure, no numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from matplotlib.figure import Figure

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evidence import Measurement, rng_like
from pirl_rl.evaluation.slices import Section
from pirl_rl.evaluation.trajectories import Trajectories, closed_loop
from pirl_rl.figures.evidence import draw_rollouts
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

LEVELS = (0.9, 0.5, 0.1)
"""V at the starts: of paths that should succeed, that may, and that should not."""


@dataclass(frozen=True)
class RolloutsEvidence:
    """V on all planes; paths on the CPU, those from one start side by side, as many from each; V at the starts."""

    sections: list[Section]
    paths: Trajectories | None
    values: list[float]

    def numbers(self) -> dict[str, float]:
        return {}

    def figures(self) -> dict[str, Figure]:
        return {"rollouts": draw_rollouts(self.sections, self.paths, self.values)} if self.paths is not None else {}


class Rollouts(Measurement):
    """Paths over the whole horizon from the states of the first plane's grid, outside A and B, where V is nearest to
    0.9, 0.5 and 0.1.

    Args:
        paths: from each start.
        points: of the planes' grids along each axis.
        dt: control step, s.
        substeps: integration steps in it.
        crossing: how exits are watched.
        seed: of the noise.
    """

    def __init__(
        self,
        paths: int = 8,
        points: int = 31,
        dt: float = 0.1,
        substeps: int = 10,
        crossing: Literal["bridge", "endpoint"] = "endpoint",
        seed: int = 0,
    ):
        if paths < 1 or points < 2:
            raise ArgumentError(f"Rollouts: expected paths >= 1 and points >= 2, got {paths} and {points}")
        self.paths, self.points, self.seed = paths, points, seed
        self.simulator = partial(Simulator, dt=dt, substeps=substeps, crossing=crossing)

    def measure(self, solution: Solution) -> RolloutsEvidence:
        problem = solution.problem
        sections = [Section.of(solution, plane, self.points) for plane in problem.planes.values()]
        if not sections:
            return RolloutsEvidence([], None, [])
        first = sections[0]
        value = torch.where(problem.interior(first.x).cpu(), first.value.flatten(), torch.inf)
        starts = torch.stack([(value - level).abs().argmin() for level in LEVELS])
        index = starts.repeat_interleave(self.paths).to(first.x.device)
        tau, x = first.tau[index], first.x[index]
        paths = closed_loop(self.simulator(problem), solution.policy, tau, x, rng_like(solution, self.seed))
        paths = Trajectories(*(entry.cpu() for entry in vars(paths).values()))
        return RolloutsEvidence(sections, paths, value[starts].tolist())
