"""Policy gradients from the returns of played actions."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.actor_rules.base import ActorRule
from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Critic
from pirl_rl.solution import Solution


class ClippedSurrogate(ActorRule):
    """The mean of min(rho A, clip(rho, 1 - c, 1 + c) A) over transitions, Eq. (clipped_surrogate).

    This is the surrogate of PPO (Schulman et al. 2017, arXiv:1707.06347). rho is the ratio of the densities of the
    played action under pi and under the policy that played it. Both are Gaussians around the actor's output; the
    clipping of actions to [-1, 1] is neglected. The advantage is A = r + (1 - d) V(y') - V(y), divided by its standard
    deviation over the batch. Unlike the other rules, this one uses the outcomes of played actions, with their noise and
    exits, and no derivative of V. It needs noise on every action, hence `collector.exploration=always`.

    Args:
        deviation: standard deviation of the exploration noise on normalised actions, above 0.
        clip: c > 0; ratios beyond 1 - c or 1 + c give no further gain.

    Raises:
        ArgumentError: `deviation` or `clip` is not positive.
    """

    def __init__(self, deviation: float, clip: float = 0.2):
        if not deviation > 0:
            raise ArgumentError(f"actor_rule.deviation: expected a standard deviation > 0, got {deviation}")
        if not clip > 0:
            raise ArgumentError(f"actor_rule.clip: expected a number > 0, got {clip}")
        self.deviation, self.clip = deviation, clip

    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        tau, x, played = replay["tau"], replay["state"], replay["action"]
        following: TensorDictBase | None = replay.get("next", None)
        if following is None:
            raise ArgumentError(
                "actor_rule: ClippedSurrogate uses returns, expected a weight of the TD loss above 0, got 0"
            )
        with torch.no_grad():
            here, there = (
                solution.critic(t, y, solution.actor(t, y)).mean(0)
                for t, y in ((tau, x), (following["tau"], following["state"]))
            )
        advantage = (following["reward"] + (~following["terminated"]) * there - here).squeeze(-1)
        advantage = advantage / advantage.std().clamp(min=torch.finfo(advantage.dtype).eps)
        old, new = ((played - center).square().sum(-1) for center in (replay["loc"], solution.actor(tau, x)))
        ratio = ((old - new) / (2 * self.deviation**2)).exp()
        clipped = ratio.clamp(1 - self.clip, 1 + self.clip)
        return torch.minimum(ratio * advantage, clipped * advantage).mean()

    def check(self, critic: Critic, exploration_noise: float | None = None) -> None:
        if critic.action_input:
            raise ArgumentError(
                "actor_rule: ClippedSurrogate takes advantages over V(tau, x), expected critic.action_input=false, "
                "got true"
            )
        if exploration_noise is not None and exploration_noise != self.deviation:
            raise ArgumentError(
                "actor_rule.deviation: expected the standard deviation of the noise on played actions, "
                f"exploration_noise = {exploration_noise}, got {self.deviation}"
            )
