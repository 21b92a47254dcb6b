"""Initial states for several trainings that play together, each of which has its own V and its own distribution."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates
from pirl_rl.sampling.undecided import UndecidedStates
from pirl_rl.solution import Solution

DRAWN = 2**18
"""The number of states of all trainings that are drawn at once, which bounds the memory."""


class StackedNetworks:
    """Networks of several trainings, with their parameters stacked in memory that stays where it is.

    Attributes:
        twins: copies of the networks of the first training, to which parameters can be lent.
        params: for each network its parameters, with a leading axis of the trainings.

    Args:
        members: for each training its networks, which have equal shapes.
    """

    def __init__(self, members: Sequence[Sequence[nn.Module]]):
        self._members = members
        self.twins = [copy.deepcopy(network) for network in members[0]]
        self.params: list[TensorDictBase] = [kind.clone() for kind in self._stacked()]

    @torch.no_grad()
    def gather(self) -> None:
        """Take over the parameters of all trainings."""
        for own, new in zip(self.params, self._stacked(), strict=True):
            own.update_(new)

    def _stacked(self) -> list[Any]:
        kinds = zip(*self._members, strict=True)
        return [TensorDict.stack([TensorDict.from_module(one) for one in kind]).data for kind in kinds]


class JointValue:
    """V of several trainings and its residual: state number i N + j of M N states has those of training i.

    Args:
        solutions: the solutions of one problem.
    """

    def __init__(self, solutions: Sequence[Solution]):
        self.members = len(solutions)
        self._networks = StackedNetworks([[one.actor, one.critic] for one in solutions])
        self._solution = Solution(solutions[0].problem, *self._networks.twins)  # type: ignore[arg-type]
        self._values = torch.func.vmap(self._lent(self._solution.raw_value))
        self._residuals = torch.func.vmap(self._lent(self._solution.residual))

    def gather(self) -> None:
        """Take over the networks as they stand."""
        self._networks.gather()

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (M N,) in [0, 1] at times to go tau (M N,), in s, and states x (M N, n), see `Solution.value`."""
        return self._solution.corrected(self._of_members(self._values, tau, x), x)

    def residual(self, tau: Tensor, x: Tensor) -> Tensor:
        """The HJB residual (M N,), in 1/s, under the policies of the trainings, see `Solution.residual`."""
        return self._of_members(self._residuals, tau, x)

    def _of_members(self, function: Callable[..., Tensor], tau: Tensor, x: Tensor) -> Tensor:
        own = (entry.unflatten(0, (self.members, -1)) for entry in (tau, x))
        return function(self._networks.params, *own).flatten()

    def _lent(self, function: Callable[[Tensor, Tensor], Tensor]) -> Callable[..., Tensor]:
        """A function of the networks as a function of their parameters, too."""

        def of_member(params: Sequence[TensorDictBase], tau: Tensor, x: Tensor) -> Tensor:
            kept, (actor, critic) = {"preserve_module_state": False}, self._networks.twins
            with params[0].to_module(actor, **kept), params[1].to_module(critic, **kept):
                return function(tau, x)

        return of_member


class JointStates:
    """The initial states of several environments side by side, each from its own distribution.

    The states of all are drawn together where only V differs, see `together`, and otherwise of one environment after
    another, each with its own random generator.

    Args:
        envs: the M environments. A number of states is a multiple of M, and the states are in the order (M, *).
    """

    def __init__(self, envs: Sequence[ReachAvoidEnv]):
        self.envs = envs
        self._values: list[JointValue] = []
        self._parts: list[InitialStates] = []
        self._together: InitialStates | None = None

    def sample(
        self,
        problem: ReachAvoidProblem,
        count: int,
        max_steps: int,
        rng: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        members = len(self.envs)
        self._enter()
        if self._together is None:
            seen = [None] * members if visited is None else visited.chunk(members)
            drawn = [
                env.initial_states.sample(problem, count // members, max_steps, env.rng, dtype, own)
                for env, own in zip(self.envs, seen, strict=True)
            ]
            return _joined(drawn, 0)
        each = max(1, DRAWN // members)
        rounds = [min(each, count // members - begun) for begun in range(0, count // members, each)]
        drawn = [self._together.sample(problem, members * size, max_steps, rng, dtype, visited) for size in rounds]
        steps, states = _joined([(s.unflatten(0, (members, -1)), x.unflatten(0, (members, -1))) for s, x in drawn], 1)
        return steps.flatten(), states.flatten(0, 1)

    def _enter(self) -> None:
        """Take over the distributions of the environments, which a stage of training may change, and V as it stands."""
        parts = [env.initial_states for env in self.envs]
        if len(parts) != len(self._parts) or any(a is not b for a, b in zip(parts, self._parts, strict=True)):
            self._parts, self._values = parts, []
            self._together = together(parts, self._values)
        for value in self._values:
            value.gather()


def together(distributions: Sequence[Any], values: list[JointValue]) -> InitialStates | None:
    """A distribution that draws the states of several trainings at once, in the order (M, *).

    Args:
        distributions: those of the M trainings.
        values: takes the V of all trainings, where the distribution asks for them.

    Returns:
        The distribution; None if a class of `distributions` is not known to differ by the V of networks alone.
    """
    joint, kinds = copy.copy(distributions[0]), {type(one) for one in distributions}
    # A class that is derived from a common one need not be common.
    if len(kinds) != 1 or not (vars(type(joint)).get("common") or kinds == {UndecidedStates}):
        return None
    if isinstance(joint, UndecidedStates):
        if not all(isinstance(one.solution, Solution) for one in distributions):
            return None
        values.append(JointValue([one.solution for one in distributions]))
        joint.take_value_of(values[-1], len(distributions))
    if hasattr(joint, "others"):
        others = together([one.others for one in distributions], values)
        if others is None:
            return None
        joint.others = others
    return joint


def _joined(drawn: Sequence[tuple[Tensor, Tensor]], axis: int) -> tuple[Tensor, Tensor]:
    steps, states = zip(*drawn, strict=True)
    return torch.cat(steps, axis), torch.cat(states, axis)
