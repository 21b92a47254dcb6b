"""An actor rule of one's own: the Hamiltonian, with a price on large controls."""

from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.actor_rules import ActorRule, Hamiltonian
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.solution import Solution


class GentleHamiltonian(ActorRule):
    """The mean over collocation points of H^u V - effort |a|^2, where a is the control in [-1, 1].

    Args:
        problem: the physics, which the package hands to every rule that asks for it.
        effort: the price of a control at its bound, in 1/s, not negative.

    Raises:
        ArgumentError: a negative effort.
    """

    def __init__(self, problem: ReachAvoidProblem, effort: float = 0.01):
        if not effort >= 0:
            raise ArgumentError(f"actor_rule.effort: expected a number >= 0, got {effort}")
        self.hamiltonian, self.effort = Hamiltonian(problem), effort

    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        action = solution.actor(points["tau"], points["state"])
        return self.hamiltonian(solution, replay, points) - self.effort * action.square().sum(-1).mean()
