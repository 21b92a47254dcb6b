"""V and Monte Carlo of the policy on two-dimensional sections of the state space, at the whole horizon."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evidence import Measurement, like, rng_like
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.figures.evidence import draw_slice
from pirl_rl.sets import Plane
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

MEANINGS = {
    "slice_<plane>_mae": "mean |masked V - Monte Carlo of the learned policy| on the plane's 31 x 31 grid, edges "
    "included, at tau = T, fine simulator; V is known inside A and B",
    "slice_<plane>_success": "mean of that Monte Carlo",
}


@dataclass(frozen=True)
class Section:
    """V (k, k) on a plane's grid at tau = T: [i, j] is at coordinate j of the first axis and i of the second."""

    plane: Plane
    axes: tuple[Tensor, Tensor]
    tau: Tensor
    x: Tensor
    value: Tensor

    @classmethod
    def of(cls, solution: Solution, plane: Plane, points: int) -> Section:
        """Args: points: along each axis; tau (k^2,) and x (k^2, n) are those of the grid, row by row."""
        first, second = (torch.linspace(a, b, points) for a, b in zip(plane.box.low, plane.box.high, strict=True))
        grid = torch.stack(torch.meshgrid(first, second, indexing="xy"), -1).reshape(-1, 2)
        tau = torch.full((len(grid),), solution.problem.horizon)
        tau, x = like(solution, tau, plane.embed(grid.double()))
        value = solution.value(tau, x).cpu().reshape(points, points)
        return cls(plane, (first, second), tau, x, value)


@dataclass(frozen=True)
class Slice:
    """Beside the section's V: mean payoff (k, k) of the policy, and its projected vector field (k, k, 2)."""

    section: Section
    monte_carlo: Tensor
    field: Tensor


@dataclass(frozen=True)
class SlicesEvidence:
    """A `Slice` of each plane, by name."""

    slices: dict[str, Slice]

    def numbers(self) -> dict[str, float]:
        numbers: dict[str, float] = {}
        for name, cut in self.slices.items():
            numbers[f"slice_{name}_mae"] = (cut.section.value - cut.monte_carlo).abs().mean().item()
            numbers[f"slice_{name}_success"] = cut.monte_carlo.mean().item()
        return numbers

    def figures(self) -> dict[str, Figure]:
        return {f"slice_{name}": draw_slice(cut) for name, cut in self.slices.items()}


class Slices(Measurement):
    """V against noise-free rollouts on a grid of each of the problem's planes.

    Args:
        points: of the grid along each axis.
        rollouts: paths from each point.
        dt: control step, s.
        substeps: integration steps in it.
        crossing: how exits are watched.
        seed: of the noise.
    """

    def __init__(
        self,
        points: int = 31,
        rollouts: int = 64,
        dt: float = 0.1,
        substeps: int = 10,
        crossing: Literal["bridge", "endpoint"] = "endpoint",
        seed: int = 0,
    ):
        if points < 2 or rollouts < 1:
            raise ArgumentError(f"Slices: expected points >= 2 and rollouts >= 1, got {points} and {rollouts}")
        self.points, self.rollouts, self.seed = points, rollouts, seed
        self.simulator = partial(Simulator, dt=dt, substeps=substeps, crossing=crossing)

    def measure(self, solution: Solution) -> SlicesEvidence:
        return SlicesEvidence({name: self._slice(solution, plane) for name, plane in solution.problem.planes.items()})

    def _slice(self, solution: Solution, plane: Plane) -> Slice:
        section = Section.of(solution, plane, self.points)
        simulator, noise = self.simulator(solution.problem), rng_like(solution, self.seed)
        mean = mean_payoff(simulator, solution.policy, section.tau, section.x, self.rollouts, noise)
        shape = (self.points, self.points)
        return Slice(section, mean.cpu().reshape(shape), projected_field(solution, section).cpu().reshape(*shape, 2))


def projected_field(solution: Solution, section: Section) -> Tensor:
    """d/dt of the plane's coordinates (k^2, 2) along the closed loop without noise, 1/s times their units."""
    velocity = solution.problem.drift(section.x, solution.policy(section.tau, section.x))
    return torch.func.jvp(section.plane.project, (section.x,), (velocity,))[1]  # type: ignore[return-value]
