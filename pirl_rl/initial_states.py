"""Initial states of episodes: x outside A and B, and whole steps to go, so that tau = steps * dt."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from pirl_rl.problem import ProblemError, ReachAvoidProblem
from pirl_rl.sets import Box

ATTEMPTS = 1_000


class UniformStates:
    """x uniform in a box, redrawn until outside A and B.

    Args:
        low: lower corner of the box; default the problem's `states`.
        high: upper corner.
        tau: "fixed" starts every episode at the whole horizon, "random" at a uniform number of steps from 1.
    """

    def __init__(
        self,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        tau: Literal["fixed", "random"] = "random",
    ):
        if tau not in ("fixed", "random"):
            raise ValueError(f"initial_states.tau: expected 'fixed' or 'random', got {tau!r}")
        if (low is None) != (high is None):
            raise ValueError("initial_states: give both low and high, or neither")
        self.box = None if low is None or high is None else Box(low, high)
        self.tau = tau

    def sample(
        self, problem: ReachAvoidProblem, count: int, max_steps: int, generator: torch.Generator, dtype: torch.dtype
    ) -> tuple[Tensor, Tensor]:
        """Steps to go (count,), int64 in [1, max_steps], and states (count, n).

        Raises:
            ProblemError: where no state outside A and B is found.
        """
        device = generator.device
        if self.tau == "fixed":
            steps = torch.full((count,), max_steps, device=device)
        else:
            steps = torch.randint(1, max_steps + 1, (count,), generator=generator, device=device)
        return steps, sample_interior(problem, self.box or problem.states, count, generator, dtype)


def sample_interior(
    problem: ReachAvoidProblem, box: Box, count: int, generator: torch.Generator, dtype: torch.dtype
) -> Tensor:
    """States (count, n), uniform in the part of a box outside A and B.

    Raises:
        ProblemError: where no such state is found.
    """
    x = box.sample(count, generator, dtype, generator.device)
    for _ in range(ATTEMPTS):
        absorbed = ~problem.interior(x)
        missing = int(absorbed.sum())
        if missing == 0:
            return x
        x[absorbed] = box.sample(missing, generator, dtype, generator.device)
    raise ProblemError(f"{type(problem).__name__}: no state outside the target and the avoid set found in {box}")
