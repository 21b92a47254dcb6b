"""The interface of an actor rule."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.networks import Critic
from pirl_rl.solution import Solution


class ActorRule(ABC):
    """An objective that the actor ascends.

    Attributes:
        compiles_whole: whether the objective is compiled as one function with the rest of the actor's loss. A rule
            that loops over the simulator is not, since the loop would be unrolled into thousands of operations; it
            compiles the body of the loop in `compile`.
        trains_choices: whether the rule can train an actor that chooses among numbers, whose output has no gradient.
    """

    compiles_whole: bool = True
    trains_choices: bool = False

    @abstractmethod
    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        """The objective, a scalar.

        Args:
            solution: the actor, whose parameters get gradients, and the critics, whose parameters do not.
            replay: N transitions with "tau" (N, 1), "state" (N, n), the played "action" (N, m) and the actor's output
                "loc" (N, m) from which it was made. If the weight of the TD loss is above 0, "next" has "tau",
                "state", "reward" and "terminated", else it is missing.
            points: K collocation points with "tau" (K, 1), "state" (K, n) and "mask" (K,), or `replay`, which has no
                mask, if the weight of the HJB residual is 0.
        """

    def check(self, critic: Critic, exploration_noise: float | None = None) -> None:  # noqa: B027
        """Refuse critics or a collector with which the rule cannot work.

        Args:
            critic: one of the critics.
            exploration_noise: standard deviation of the noise on played actions, or None if it is not known yet.

        Raises:
            ArgumentError: the rule does not work with them.
        """

    def compile(self, compiler: Callable[[Any], Any]) -> None:  # noqa: B027
        """Compile the inner functions of a rule that is not compiled as a whole.

        Args:
            compiler: returns the compiled version of a function, or the function itself if nothing is compiled.
        """
