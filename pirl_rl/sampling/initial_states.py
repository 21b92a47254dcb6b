"""Initial states of episodes: x outside A and B, and a number of control steps to go, see `pirl_rl.clock`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError, ProblemError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box

ATTEMPTS = 1_000
"""How often states inside A or B are drawn again."""

Tau = Literal["fixed", "random", "both"]


@runtime_checkable
class InitialStates(Protocol):
    """A distribution of the initial states of episodes.

    A class with the attribute `common = True` promises that its states depend neither on V nor on `visited`, except for
    those of a distribution in its attribute `others`. Trainings that play together on a GPU then draw theirs at once.
    """

    def sample(
        self,
        problem: Any,
        count: int,
        max_steps: int,
        rng: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Draw initial states.

        Args:
            problem: gives the sets and the box of states.
            count: the number of initial states.
            max_steps: the number of control steps in the horizon.
            rng: the random generator, on whose device the results are.
            dtype: the dtype of the states.
            visited: states (k, n) of the paths that are under way, if there are any.

        Returns:
            Control steps to go (count,), int64 in [1, max_steps], and states (count, n) outside A and B.

        Raises:
            ProblemError: no state outside A and B is found.
        """
        ...


class UniformStates:
    """States uniform in the part of a box outside A and B.

    Args:
        low: lower corner of the box, n numbers; by default the box is `states` of the problem.
        high: upper corner of the box, n numbers.
        tau: "fixed" gives every episode the whole horizon, "random" a uniform number of control steps from 1 to that,
            "both" chooses between the two with equal probability.

    Raises:
        ArgumentError: only one corner is given, the corners are no box, or `tau` is unknown.
    """

    common = True

    def __init__(
        self,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        tau: Tau = "random",
    ):
        check_tau(tau)
        if (low is None) != (high is None):
            raise ArgumentError(f"initial_states: give both low and high, or neither; got low={low}, high={high}")
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
        box, n = self.box or problem.states, problem.states.dim
        if box.dim != n:
            raise ArgumentError(f"initial_states: expected low and high of {n} numbers, one a state, got {box.dim}")
        x = sample_interior(problem, box, count, rng, dtype)
        return steps_to_go(self.tau, count, max_steps, rng), x


class VisitedStates:
    """States near those that other paths of the batch are in, mixed with states from another distribution.

    Initial states thus spread along the paths of the current policy. A visited state is moved in a random direction in
    the coordinates in which `problem.states` is [-1, 1]^n. If it then lies in A or B or is unreachable, a state from
    the other distribution takes its place.

    Args:
        others: the other distribution, which also gives the steps to go of all episodes.
        share: the probability of a visited state, in [0, 1].
        radius: the length of the move is uniform in [0, radius].

    Raises:
        ArgumentError: a number is out of range.
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
        states = problem.states
        near = states.wrap(states.denormalize(moved(states.normalize(start), self.radius, rng)))
        return steps, mixed(problem, near, x, self.share, rng)


def mixed(problem: ReachAvoidProblem, x: Tensor, others: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """States (N, n): each of x (N, n) with the probability `share`, and else the one of `others` (N, n).

    Where a state of x lies in A or B, or is unreachable, the other one takes its place in any case.
    """
    taken = torch.rand(len(x), generator=rng, device=rng.device) < share
    taken = taken & problem.interior(x) & ~problem.unreachable(x)
    return torch.where(taken.unsqueeze(-1), x, others)


def moved(z: Tensor, radius: float, rng: torch.Generator) -> Tensor:
    """The points z (N, d), each moved in a random direction by a length uniform in [0, radius]."""
    direction = torch.randn(z.shape, generator=rng, dtype=z.dtype, device=z.device)
    length = radius * torch.rand((len(z), 1), generator=rng, dtype=z.dtype, device=z.device)
    return z + length * direction / direction.norm(dim=-1, keepdim=True)


def check_tau(tau: str) -> None:
    """Refuse an unknown rule for the steps to go.

    Raises:
        ArgumentError: `tau` is not "fixed", "random" or "both".
    """
    if tau not in get_args(Tau):
        raise ArgumentError(f"initial_states.tau: expected 'fixed', 'random' or 'both', got {tau!r}")


def steps_to_go(tau: Tau, count: int, max_steps: int, rng: torch.Generator) -> Tensor:
    """Control steps to go (count,), int64 in [1, max_steps], by a rule of `UniformStates`."""
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
        ProblemError: no such state is found.
    """
    return redrawn(problem, count, lambda missing: problem.states.wrap(box.sample(missing, rng, dtype, rng.device)))


def redrawn(problem: ReachAvoidProblem, count: int, draw: Callable[[int], Tensor]) -> Tensor:
    """States (count, n) outside A and B.

    Args:
        problem: gives the sets.
        count: the number of states.
        draw: draws the given number of states; states inside A or B are drawn again.

    Raises:
        ProblemError: fewer states than asked for are found, if any.
    """
    x = draw(count)
    for attempt in range(2 * ATTEMPTS):
        absorbed = (~problem.interior(x)).nonzero().squeeze(-1)
        missing = len(absorbed)
        if missing == 0:
            return x
        if attempt < ATTEMPTS:
            x[absorbed] = draw(missing)
            continue
        if missing == count:
            break
        # Where hardly any state is outside both sets, the last ones are found among many candidates.
        others = draw(count)
        others = others[problem.interior(others)][:missing]
        x[absorbed[: len(others)]] = others
    raise ProblemError(f"{type(problem).__name__}: no initial state outside the target and the avoid set found")
