"""Where paths end, and what a bound may be there.

A function W bounds the probability of success of one policy, or the probability of failure of all policies, from below.
Success is to come to A before B, or to stay outside B in an invariance problem; failure is that this does not happen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem

NEAR = 1e-9
"""A level within this share of its size over the box of states counts as 0 where W is fitted, which proves nothing."""

STATES = 4_096
"""The number of states of the box from which the size of a level is taken."""


class Absorbing(NamedTuple):
    """A set in which paths end.

    Attributes:
        name: A or B.
        levels: its levels (N, k) at states (N, n), tensors or affine forms.
        intersection: whether the set is where all of them are <= 0, and not where one of them is.
        most: the largest value of W on its face.
    """

    name: str
    levels: Callable[[Any], Any]
    intersection: bool
    most: float


@dataclass(frozen=True)
class Ends:
    """The sets in which paths end, and the values that W must not exceed there.

    Attributes:
        problem: the physics, with the indicator as its payoff.
        success: whether W bounds the probability of success; otherwise it bounds that of failure.
    """

    problem: ReachAvoidProblem
    success: bool

    @property
    def at_target(self) -> float:
        """The largest value of W on the face of A."""
        return self._value(1.0)

    @property
    def at_avoid(self) -> float:
        """The largest value of W on the face of B."""
        return self._value(0.0)

    @property
    def at_start(self) -> float:
        """The largest value of W outside A and B at tau = 0."""
        return self._value(float(self.problem.objective == "invariance"))

    def _value(self, success: float) -> float:
        return success if self.success else 1 - success

    @property
    def has_target(self) -> bool:
        return self.problem.objective == "reach-avoid"

    @property
    def has_rounded_avoid(self) -> bool:
        """Whether W is 1 on the faces of B, and these may meet."""
        problem = self.problem
        if self.success or not problem.has_avoid_set or problem.states.dim == 1:
            return False
        return self.avoid(torch.zeros(1, problem.states.dim, dtype=torch.float64)).shape[-1] > 1

    def target(self, x: Any) -> Any:
        """Levels (N, k) at states (N, n), tensors or affine forms, whose intersection is A."""
        return self.problem.free_target_constraints(x)

    def avoid(self, x: Any) -> Any:
        """Levels (N, k) at states (N, n), tensors or affine forms, whose union is B."""
        return self.problem.avoid_constraints(x)

    def sets(self) -> list[Absorbing]:
        """The sets in which paths end."""
        sets = [Absorbing("A", self.target, True, self.at_target)] if self.has_target else []
        return sets + ([Absorbing("B", self.avoid, False, self.at_avoid)] if self.problem.has_avoid_set else [])

    def in_target(self, x: Tensor) -> Tensor:
        """Whether states (N, n) lie in A, or next to its face within rounding, (N,) bool."""
        if not self.has_target:
            return torch.zeros(len(x), dtype=torch.bool)
        return (self.target(x) <= self._tolerances[0]).all(-1)

    def in_avoid(self, x: Tensor) -> Tensor:
        """Whether states (N, n) lie in B, or next to its face within rounding, (N,) bool."""
        if not self.problem.has_avoid_set:
            return torch.zeros(len(x), dtype=torch.bool)
        return (self.avoid(x) <= self._tolerances[1]).any(-1)

    @cached_property
    def _tolerances(self) -> tuple[Tensor, Tensor]:
        """The values of the levels of A and of B that count as 0."""
        x = self.problem.states.sample(STATES, torch.Generator().manual_seed(0), torch.float64)
        none = torch.zeros(1, dtype=torch.float64)
        return (
            NEAR * self.target(x).abs().amax(0) if self.has_target else none,
            NEAR * self.avoid(x).abs().amax(0) if self.problem.has_avoid_set else none,
        )
