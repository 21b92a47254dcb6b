"""The interface of an actor rule."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.networks import Critic
from pirl_rl.solution import Solution


class ActorRule(ABC):
    """An objective that the actor ascends.

    Attributes:
        compiles_whole: whether the objective is compiled as one function together with the rest of the actor's loss.
            A rule that loops over the simulator is not, since the loop would unroll into thousands of operations; it
            then compiles its inner function in `compile`.
    """

    compiles_whole: ClassVar[bool] = True

    @abstractmethod
    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        """The objective, a scalar.

        Args:
            solution: the actor, whose parameters take gradients, and the critics, whose parameters do not.
            replay: N transitions with "tau" (N, 1), "state" (N, n), the played "action" (N, m), the actor's output
                "loc" (N, m) behind it, and where returns are wanted "next" with "tau", "state", "reward" and
                "terminated".
            points: collocation points with "tau", "state" and "mask" (N,); the states of `replay`, without a mask,
                where no physics is imposed.
        """

    def check(self, critic: Critic, exploration_noise: float | None = None) -> None:  # noqa: B027
        """Refuse critics or a collector with which the rule cannot work.

        Args:
            critic: one of the critics.
            exploration_noise: standard deviation of the noise on played actions, if it is known.

        Raises:
            ArgumentError: with what was expected and what was got.
        """

    def compile(self, compiler: Callable[[Any], Any]) -> None:  # noqa: B027
        """Compile inner functions of a rule that is not compiled as a whole.

        Args:
            compiler: gives the compiled version of a function, or the function itself where nothing is compiled.
        """
