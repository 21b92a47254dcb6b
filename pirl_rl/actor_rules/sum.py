"""The sum of several actor rules."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.actor_rules.base import ActorRule
from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Critic
from pirl_rl.solution import Solution


class Sum(ActorRule):
    """The sum of the objectives of several rules.

    Args:
        rules: at least one rule.

    Raises:
        ArgumentError: there is no rule.
    """

    def __init__(self, rules: Sequence[ActorRule]):
        if not rules:
            raise ArgumentError("actor_rule.rules: expected at least one rule, got none")
        self.rules = tuple(rules)

    @property
    def compiles_whole(self) -> bool:  # type: ignore[override]
        """Whether all rules can be compiled as one function."""
        return all(rule.compiles_whole for rule in self.rules)

    @property
    def trains_choices(self) -> bool:  # type: ignore[override]
        """Whether all rules can train an actor that chooses among numbers."""
        return all(rule.trains_choices for rule in self.rules)

    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        first, *others = (rule(solution, replay, points) for rule in self.rules)
        return sum(others, first)

    def check(self, critic: Critic, exploration_noise: float | None = None) -> None:
        for rule in self.rules:
            rule.check(critic, exploration_noise)

    def compile(self, compiler: Callable[[Any], Any]) -> None:
        for rule in self.rules:
            rule.compile(compiler)
