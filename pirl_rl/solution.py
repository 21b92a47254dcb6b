"""A solution: a problem, the actor and the critics that were learned for it.

It says what the networks say: the value V(tau, x), the policy that should attain it, the gradient and the HJB residual
of V. Reading a solution needs no training loss.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.networks import Actor, Critic
from pirl_rl.operators import generator
from pirl_rl.problem import ReachAvoidProblem


class Solution:
    """V is the mean of the critics at u = pi(tau, x).

    In every method tau is (N,) in s and x is (N, n) in SI units; answers are in the networks' dtype.

    Args:
        problem: the physics.
        actor: pi(tau, x).
        critic: all critics as one module whose parameters carry a leading axis, see `pirl_rl.networks.stack`.
    """

    def __init__(self, problem: ReachAvoidProblem, actor: Actor, critic: Critic):
        self.problem, self.actor, self.critic = problem, actor, critic

    @property
    def dtype(self) -> torch.dtype:
        return next(self.actor.parameters()).dtype

    @property
    def device(self) -> torch.device:
        return next(self.actor.parameters()).device

    @torch.no_grad()
    def policy(self, tau: Tensor, x: Tensor) -> Tensor:
        """The physical control (N, m)."""
        return self.problem.controls.denormalize(self._action(*self._own(tau, x)))

    @torch.no_grad()
    def raw_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """The networks' own V (N,), with no knowledge of the sets."""
        tau, x = self._own(tau, x)
        return self.critic.at(self._action(tau, x))(tau, x).mean(0)

    @torch.no_grad()
    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (N,) in [0, 1]: 1 where a path has succeeded, 0 where it failed or cannot succeed, else `raw_value`."""
        lost = self.problem.failed(x) | self.problem.unreachable(x)
        return self.raw_value(tau, x).clamp(0, 1).masked_fill(self.problem.reached(x), 1.0).masked_fill(lost, 0.0)

    @torch.no_grad()
    def residual(self, tau: Tensor, x: Tensor, u: Tensor | None = None) -> Tensor:
        """L^u V (N,) in 1/s, the critics' action frozen at the policy; u (N, m) physical, default the policy's."""
        tau, x = self._own(tau, x)
        action = self._action(tau, x)
        u = self.problem.controls.denormalize(action) if u is None else u
        return generator(self.critic.at(action), self.problem, tau, x, u).mean(0)

    def gradient(self, tau: Tensor, x: Tensor) -> Tensor:
        """grad_x of `raw_value` (N, n), the critics' action frozen at the policy."""
        tau, x = self._own(tau, x)
        action = self._action(tau, x).detach()
        x = x.detach().requires_grad_()
        value = self.critic.at(action)(tau, x).mean(0)
        return torch.autograd.grad(value.sum(), x)[0]

    def _own(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(tensor.to(self.dtype) for tensor in tensors)

    def _action(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.actor(tau.unsqueeze(-1), x)
