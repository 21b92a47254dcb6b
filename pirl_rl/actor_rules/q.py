"""The deterministic policy gradient."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.actor_rules.base import ActorRule
from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Critic
from pirl_rl.solution import Solution


class Q(ActorRule):
    """The mean of Q_1(y, pi(y)) over transitions, Eq. (actor_loss)."""

    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        tau, x = replay["tau"], replay["state"]
        return solution.critic(tau, x, solution.actor(tau, x))[0].mean()

    def check(self, critic: Critic, exploration_noise: float | None = None) -> None:
        if not critic.action_input:
            raise ArgumentError(
                "actor_rule: Q needs critics Q(tau, x, u), expected critic.action_input=true, got false; critics "
                "V(tau, x) go with Hamiltonian, LookAhead or ClippedSurrogate"
            )
