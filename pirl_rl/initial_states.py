"""Initial states of episodes: x outside A and B, and whole steps to go, so that tau = steps * dt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import torch
from torch import Tensor

from pirl_rl.problem import ProblemError, ReachAvoidProblem
from pirl_rl.problems import VehicleDrift
from pirl_rl.sets import Box

ATTEMPTS = 1_000
Tau = Literal["fixed", "random", "both"]


@runtime_checkable
class InitialStates(Protocol):
    """The law of episodes' starts."""

    def sample(
        self,
        problem: Any,
        count: int,
        max_steps: int,
        generator: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Steps to go (count,), int64 in [1, max_steps], and states (count, n) outside A and B.

        Args:
            visited: states (k, n) on the paths that are being played, where there are any.

        Raises:
            ProblemError: where no state outside A and B is found.
        """
        ...


class UniformStates:
    """x uniform in a box, redrawn until outside A and B.

    Args:
        low: lower corner of the box; default the problem's `states`.
        high: upper corner.
        tau: "fixed" starts every episode at the whole horizon, "random" at a uniform number of steps from 1, "both"
            half of the episodes each.
    """

    def __init__(
        self,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        tau: Tau = "random",
    ):
        _check_tau(tau)
        if (low is None) != (high is None):
            raise ValueError("initial_states: give both low and high, or neither")
        self.box = None if low is None or high is None else Box(low, high)
        self.tau: Tau = tau

    def sample(
        self,
        problem: ReachAvoidProblem,
        count: int,
        max_steps: int,
        generator: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        x = sample_interior(problem, self.box or problem.states, count, generator, dtype)
        return _steps(self.tau, count, max_steps, generator), x


class EquilibriumStates:
    """Around the drift equilibrium of a random friction: states displaced in some of the problem's planes.

    Friction is uniform in the band of the targets. A state lies in one of the two planes, beta-r or e_y-e_psi, or is
    displaced in all four coordinates; these are uniform in the planes' boxes, contracted towards the equilibrium. The
    other entries are those of the equilibrium.

    Args:
        scale: 1 is the whole box, 0 the equilibrium; of two numbers, each start draws its own between them.
        mixture: shares of the beta-r plane, the e_y-e_psi plane, and both together.
        tau: as of `UniformStates`.
    """

    def __init__(
        self,
        scale: float | Sequence[float] = 1.0,
        mixture: Sequence[float] = (0.3, 0.3, 0.4),
        tau: Tau = "random",
    ):
        _check_tau(tau)
        low, high = scale if isinstance(scale, Sequence) else (scale, scale)
        if not 0 <= low <= high <= 1 or high == 0:
            raise ValueError(f"initial_states.scale: expected one or two numbers, 0 <= low <= high <= 1, got {scale}")
        if len(mixture) != 3 or min(mixture) < 0 or not sum(mixture) > 0:
            raise ValueError(f"initial_states.mixture: expected three shares >= 0, got {list(mixture)}")
        self.scale, self.mixture = (low, high), tuple(mixture)
        self.tau: Tau = tau

    def sample(
        self,
        problem: VehicleDrift,
        count: int,
        max_steps: int,
        generator: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        x = redrawn(problem, count, lambda missing: self._draw(problem, missing, generator, dtype))
        return _steps(self.tau, count, max_steps, generator), x

    def _draw(self, problem: VehicleDrift, count: int, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
        device = generator.device
        low, high = problem.friction_band
        friction = low + (high - low) * torch.rand(count, generator=generator, dtype=dtype, device=device)
        center = problem.around_equilibrium(friction)
        shrink = self.scale[0] + (self.scale[1] - self.scale[0]) * torch.rand(
            (count, 1), generator=generator, dtype=dtype, device=device
        )
        shares = torch.tensor(self.mixture, dtype=torch.float64, device=device)
        kind = torch.multinomial(shares, count, replacement=True, generator=generator).unsqueeze(-1)
        chosen = []
        for index, plane in enumerate(problem.planes.values()):
            middle = plane.project(center)
            point = middle + shrink * (plane.box.sample(count, generator, dtype, device) - middle)
            chosen.append(torch.where((kind == index) | (kind == 2), point, middle))
        (beta, r), (e_y, e_psi) = (points.unbind(-1) for points in chosen)
        return problem.around_equilibrium(friction, e_y=e_y, e_psi=e_psi, beta=beta, r=r)


class VisitedStates:
    """A share of the starts near states that the batch of paths has just come to, the rest from another law.

    Starts thus spread along the paths of the current policy. A visited state is moved in a random direction of the
    coordinates in which `problem.states` is [-1, 1]^n; one that then lies in A or B, or is known as unreachable, is
    replaced by one of the other law.

    Args:
        others: law of the rest, and of tau for all.
        share: of visited states.
        radius: largest length of the move, uniform in [0, radius].
    """

    def __init__(self, others: InitialStates, share: float = 0.5, radius: float = 0.4):
        if not 0 <= share <= 1 or not radius >= 0:
            raise ValueError(f"initial_states: expected 0 <= share <= 1 and radius >= 0, got {share} and {radius}")
        self.others, self.share, self.radius = others, share, radius

    def sample(
        self,
        problem: ReachAvoidProblem,
        count: int,
        max_steps: int,
        generator: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        steps, x = self.others.sample(problem, count, max_steps, generator, dtype)
        if visited is None or not len(visited):
            return steps, x
        device = generator.device
        start = visited[torch.randint(len(visited), (count,), generator=generator, device=device)]
        near = problem.states.denormalize(moved(problem.states.normalize(start), self.radius, generator))
        taken = torch.rand(count, generator=generator, device=device) < self.share
        taken = taken & problem.interior(near) & ~problem.unreachable(near)
        return steps, torch.where(taken.unsqueeze(-1), near, x)


def moved(z: Tensor, radius: float, generator: torch.Generator) -> Tensor:
    """Points (N, d), each moved in a random direction by a length uniform in [0, radius]."""
    direction = torch.randn(z.shape, generator=generator, dtype=z.dtype, device=z.device)
    length = radius * torch.rand((len(z), 1), generator=generator, dtype=z.dtype, device=z.device)
    return z + length * direction / direction.norm(dim=-1, keepdim=True)


def _check_tau(tau: str) -> None:
    if tau not in get_args(Tau):
        raise ValueError(f"initial_states.tau: expected 'fixed', 'random' or 'both', got {tau!r}")


def _steps(tau: Tau, count: int, max_steps: int, generator: torch.Generator) -> Tensor:
    if tau == "fixed":
        return torch.full((count,), max_steps, device=generator.device)
    steps = torch.randint(1, max_steps + 1, (count,), generator=generator, device=generator.device)
    if tau == "both":
        steps[torch.rand(count, generator=generator, device=generator.device) < 0.5] = max_steps
    return steps


def sample_interior(
    problem: ReachAvoidProblem, box: Box, count: int, generator: torch.Generator, dtype: torch.dtype
) -> Tensor:
    """States (count, n), uniform in the part of a box outside A and B.

    Raises:
        ProblemError: where no such state is found.
    """
    return redrawn(problem, count, lambda missing: box.sample(missing, generator, dtype, generator.device))


def redrawn(problem: ReachAvoidProblem, count: int, draw: Callable[[int], Tensor]) -> Tensor:
    """States (count, n), those of `draw` inside A or B drawn again.

    Raises:
        ProblemError: where no other state is found.
    """
    x = draw(count)
    for _ in range(ATTEMPTS):
        absorbed = ~problem.interior(x)
        missing = int(absorbed.sum())
        if missing == 0:
            return x
        x[absorbed] = draw(missing)
    raise ProblemError(f"{type(problem).__name__}: no initial state outside the target and the avoid set found")
