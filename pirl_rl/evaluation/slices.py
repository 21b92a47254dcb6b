"""V and Monte Carlo of the policy on two-dimensional sections of the state space, at one time to go."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.inputs import like, noise_rng
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.evaluation.planes import plane_names, planes_of
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Plane
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

OUTLINE = 151
"""The number of points along each axis of a plane on which the outlines of A and B are found."""

SPREAD = 0.1
"""A section shows little where the standard deviation of V over its points outside A and B is below this."""

HALVINGS = 5
"""The number of times that the time to go is halved in search of a section on which V varies."""


@dataclass(frozen=True)
class Section:
    """V on the grid of k x k points of a plane, at one time to go.

    Attributes:
        plane: the plane.
        axes: the coordinates (k,) of the grid along the first and along the second axis.
        tau: times to go (k^2,) in s, all equal.
        x: states (k^2, n) in SI units, row by row of the grid.
        value: V (k, k); entry [i, j] is at coordinate j of the first axis and i of the second.
        reached, failed: whether points lie in A and in B, bool, on a grid of `OUTLINE` points along each axis.
    """

    plane: Plane
    axes: tuple[Tensor, Tensor]
    tau: Tensor
    x: Tensor
    value: Tensor
    reached: Tensor
    failed: Tensor

    @classmethod
    def of(cls, solution: Solution, plane: Plane, points: int, time: float) -> Section:
        """V of a solution on a plane, with `points` grid points along each axis, at a time to go in s."""
        problem, axes, grid = solution.problem, *_grid(plane, points)
        tau, x = like(solution, torch.full((len(grid),), time), grid)
        x = problem.states.wrap(x)
        value = solution.value(tau, x).cpu().reshape(points, points)
        fine = problem.states.wrap(_grid(plane, OUTLINE)[1])
        sets = [inside.reshape(OUTLINE, OUTLINE) for inside in (problem.reached(fine), problem.failed(fine))]
        return cls(plane, axes, tau, x, value, *sets)

    @classmethod
    def telling(cls, solution: Solution, plane: Plane, points: int) -> Section:
        """The section at tau = T or, where V hardly varies on the plane then, at the largest T / 2^k at which it does.

        A target that can be reached from everywhere in T has V = 1 all over the plane, which says nothing. If V varies
        at none of these times, the section is that at tau = T.
        """
        horizon = solution.problem.horizon
        times = [horizon / 2**k for k in range(HALVINGS + 1)]
        sections = []
        for time in times:
            sections.append(cls.of(solution, plane, points, time))
            if sections[-1].spread(solution.problem) >= SPREAD:
                return sections[-1]
        return sections[0]

    @property
    def time(self) -> float:
        """The time to go in s."""
        return self.tau[0].item()

    def spread(self, problem: ReachAvoidProblem) -> float:
        """The standard deviation of V over the points outside A and B, or 0 where there are none."""
        inside = problem.interior(self.x).cpu()
        return self.value.flatten()[inside].std(correction=0).item() if bool(inside.any()) else 0.0


def _grid(plane: Plane, points: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """The coordinates (k,) along both axes of a plane, and the states (k^2, n), float64, of its grid."""
    first, second = (torch.linspace(a, b, points) for a, b in zip(plane.box.low, plane.box.high, strict=True))
    grid = torch.stack(torch.meshgrid(first, second, indexing="xy"), -1).reshape(-1, 2)
    return (first, second), plane.embed(grid.double())


@dataclass(frozen=True)
class Slice:
    """The learned policy on a section.

    Attributes:
        section: the section.
        monte_carlo: mean payoffs (k, k).
        field: the drift of the closed loop in the coordinates of the plane (k, k, 2), per s.
        action: controls (k, k, m), normalised to [-1, 1].
        rollouts: the number of paths from each point.
    """

    section: Section
    monte_carlo: Tensor
    field: Tensor
    action: Tensor
    rollouts: int

    @property
    def mae(self) -> float:
        """The mean of |V - Monte Carlo|."""
        return (self.section.value - self.monte_carlo).abs().mean().item()


@dataclass(frozen=True)
class SlicesEvidence:
    """The slices of all planes, by the planes' names."""

    slices: dict[str, Slice]

    def metrics(self) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for name, cut in self.slices.items():
            metrics[f"slice_{name}_tau"] = cut.section.time
            metrics[f"slice_{name}_mae"] = cut.mae
            metrics[f"slice_{name}_success"] = cut.monte_carlo.mean().item()
        return metrics


class Slices:
    """Compares V with rollouts on a grid of each plane, see `planes_of`; with one state there is none.

    Args:
        points: number of grid points along each axis, at least 2.
        rollouts: number of paths from each point.
        seed: seed of the noise.

    Raises:
        ArgumentError: if there are fewer than two points, or no rollout.
    """

    def __init__(self, points: int = 31, rollouts: int = 64, seed: int = 0):
        if points < 2 or rollouts < 1:
            raise ArgumentError(f"Slices: expected points >= 2 and rollouts >= 1, got {points} and {rollouts}")
        self.points, self.rollouts, self.seed = points, rollouts, seed

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        meanings: dict[str, str] = {}
        for name in plane_names(problem):
            meanings[f"slice_{name}_tau"] = (
                f"The time to go of the slice {name} in s: the horizon or, where V hardly varies on the plane then, "
                "the largest of its half, its quarter and so on at which it does."
            )
            meanings[f"slice_{name}_mae"] = (
                f"The mean of |V - Monte Carlo|, the latter the mean payoff of {self.rollouts:,} rollouts of the "
                f"policy, on the {self.points} x {self.points} grid of the plane {name}, edges included, at "
                f"tau = slice_{name}_tau; V is 1 in A and 0 in B."
            )
            meanings[f"slice_{name}_success"] = f"The mean of the Monte Carlo in slice_{name}_mae."
        return meanings

    def __call__(self, solution: Solution, simulator: Simulator) -> SlicesEvidence:
        planes = planes_of(solution)
        return SlicesEvidence({name: self._slice(solution, simulator, plane) for name, plane in planes.items()})

    def _slice(self, solution: Solution, simulator: Simulator, plane: Plane) -> Slice:
        section = Section.telling(solution, plane, self.points)
        noise = noise_rng(solution, self.seed)
        mean = mean_payoff(simulator, solution.policy, section.tau, section.x, self.rollouts, noise)
        shape = (self.points, self.points)
        field = projected_field(solution, section).cpu().reshape(*shape, 2)
        action = solution.problem.controls.normalize(solution.policy(section.tau, section.x))
        return Slice(section, mean.cpu().reshape(shape), field, action.cpu().reshape(*shape, -1), self.rollouts)


def projected_field(solution: Solution, section: Section) -> Tensor:
    """Time derivative (k^2, 2) of the plane's coordinates under the learned policy, without noise, per second."""
    velocity = solution.problem.drift(section.x, solution.policy(section.tau, section.x))
    return torch.func.jvp(section.plane.project, (section.x,), (velocity,))[1]  # type: ignore[return-value]
