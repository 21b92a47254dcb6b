"""Initial states of episodes: x outside A and B, and whole steps to go, so that tau = steps * dt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError, ProblemError
from pirl_rl.problem import ReachAvoidProblem
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
        rng: torch.Generator,
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
        check_tau(tau)
        if (low is None) != (high is None):
            raise ArgumentError("initial_states: give both low and high, or neither")
        self.box = None if low is None or high is None else Box(low, high)
        self.tau: Tau = tau

    def sample(
        self,
        problem: ReachAvoidProblem,
        count: int,
        max_steps: int,
        rng: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        x = sample_interior(problem, self.box or problem.states, count, rng, dtype)
        return steps_to_go(self.tau, count, max_steps, rng), x


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
            raise ArgumentError(f"initial_states: expected 0 <= share <= 1 and radius >= 0, got {share} and {radius}")
        self.others, self.share, self.radius = others, share, radius

    def sample(
        self,
        problem: ReachAvoidProblem,
        count: int,
        max_steps: int,
        rng: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        steps, x = self.others.sample(problem, count, max_steps, rng, dtype)
        if visited is None or not len(visited):
            return steps, x
        device = rng.device
        start = visited[torch.randint(len(visited), (count,), generator=rng, device=device)]
        near = problem.states.denormalize(moved(problem.states.normalize(start), self.radius, rng))
        taken = torch.rand(count, generator=rng, device=device) < self.share
        taken = taken & problem.interior(near) & ~problem.unreachable(near)
        return steps, torch.where(taken.unsqueeze(-1), near, x)


def moved(z: Tensor, radius: float, rng: torch.Generator) -> Tensor:
    """Points (N, d), each moved in a random direction by a length uniform in [0, radius]."""
    direction = torch.randn(z.shape, generator=rng, dtype=z.dtype, device=z.device)
    length = radius * torch.rand((len(z), 1), generator=rng, dtype=z.dtype, device=z.device)
    return z + length * direction / direction.norm(dim=-1, keepdim=True)


def check_tau(tau: str) -> None:
    if tau not in get_args(Tau):
        raise ArgumentError(f"initial_states.tau: expected 'fixed', 'random' or 'both', got {tau!r}")


def steps_to_go(tau: Tau, count: int, max_steps: int, rng: torch.Generator) -> Tensor:
    if tau == "fixed":
        return torch.full((count,), max_steps, device=rng.device)
    steps = torch.randint(1, max_steps + 1, (count,), generator=rng, device=rng.device)
    if tau == "both":
        steps[torch.rand(count, generator=rng, device=rng.device) < 0.5] = max_steps
    return steps


def sample_interior(
    problem: ReachAvoidProblem, box: Box, count: int, rng: torch.Generator, dtype: torch.dtype
) -> Tensor:
    """States (count, n), uniform in the part of a box outside A and B.

    Raises:
        ProblemError: where no such state is found.
    """
    return redrawn(problem, count, lambda missing: box.sample(missing, rng, dtype, rng.device))


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
