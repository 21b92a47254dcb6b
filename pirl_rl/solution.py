"""A solution: a problem with the actor and the critics that were learned for it.

It evaluates the learned value V(tau, x), its gradient and its HJB residual, and the learned policy. It does not need
the training loss.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Actor, Critic, CriticValue
from pirl_rl.operators import generator
from pirl_rl.problem import ReachAvoidProblem

CHUNK_ENTRIES = 2**22
"""Number of entries of sigma, over all points whose residual is computed at once, which bounds the memory."""


class Solution:
    """The learned value and policy, where V is the mean of the critics at u = pi(tau, x).

    In every method tau is (N,), in s, and x is (N, n), in SI units; periodic coordinates may lie outside their period.
    Results have the dtype of the networks.

    Args:
        problem: the physics.
        actor: the policy pi(tau, x).
        critic: all critics in one module whose parameters have a leading axis, see `pirl_rl.networks.stack`.
    """

    def __init__(self, problem: ReachAvoidProblem, actor: Actor, critic: Critic):
        self.problem, self.actor, self.critic = problem, actor, critic

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the networks."""
        return self._weight.dtype

    @property
    def device(self) -> torch.device:
        """The device of the networks."""
        return self._weight.device

    @property
    def _weight(self) -> Tensor:
        """One of the weights of the actor."""
        # In a loss of a population the actor has no parameters, but tensors that `torch.func.vmap` has wrapped.
        parameter = next(self.actor.parameters(), None)
        return self.actor.layers[-2].weight if parameter is None else parameter  # type: ignore[return-value]

    def arrays(self) -> dict[str, np.ndarray]:
        """All numbers that the policy and V are computed from, by name."""
        states = {"actor": self.actor.state_dict(), "critic": self.critic.state_dict()}
        return {
            f"{kind}.{name}": entry.cpu().numpy() for kind, state in states.items() for name, entry in state.items()
        }

    @torch.no_grad()
    def policy(self, tau: Tensor, x: Tensor) -> Tensor:
        """The control pi(tau, x) (N, m), in SI units."""
        return self.problem.controls.denormalize(self._action(*self._own(tau, x)))

    @torch.no_grad()
    def raw_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (N,) as the networks give it, neither clipped nor corrected inside A and B."""
        tau, x = self._own(tau, x)
        return self._critics(tau, x)(tau, x).mean(0)

    @torch.no_grad()
    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (N,): 1 in A, 0 in B and in unreachable states, and elsewhere `raw_value` clipped to [0, 1]."""
        return self.corrected(self.raw_value(tau, x), x)

    @torch.no_grad()
    def corrected(self, v: Tensor, x: Tensor) -> Tensor:
        """`value` (N,), given the `raw_value` v (N,)."""
        x = self.problem.states.wrap(x)
        lost = self.problem.failed(x) | self.problem.unreachable(x)
        return v.clamp(0, 1).masked_fill(self.problem.reached(x), 1.0).masked_fill(lost, 0.0)

    @torch.no_grad()
    def residual(self, tau: Tensor, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The HJB residual L^u V (N,), in 1/s, Eq. (parabolic_operator); the action of the critics is frozen.

        Args:
            tau: times to go (N,), in s.
            x: states (N, n).
            u: controls (N, m) in f and sigma, in SI units; default pi(tau, x), as in Eq. (linear_pde).
        """
        tau, x = self._own(tau, x)
        action = self._action(tau, x)
        u = self.problem.controls.denormalize(action) if u is None else u
        entries = max(1, self.problem.diffusion(x[:1], u[:1]).numel())
        size = max(1, CHUNK_ENTRIES // entries)
        parts = zip(*(entry.split(size) for entry in (tau, x, action, u)), strict=True)
        return torch.cat([generator(self.critic.at(a), self.problem, t, y, v).mean(0) for t, y, a, v in parts])

    # The next two are called by compiled losses. The compiler does not follow decorators of methods of objects that
    # are made while it traces, hence the blocks.

    def gradient(self, tau: Tensor, x: Tensor) -> Tensor:
        """The gradient of `raw_value` in x (N, n), per unit of the state; the action of the critics is frozen."""
        with torch.no_grad():
            tau, x = self._own(tau, x)
            value = self._critics(tau, x)
            return torch.func.grad(lambda y: value(tau, y).mean(0).sum())(x)

    def hessian(self, tau: Tensor, x: Tensor) -> Tensor:
        """The second derivatives of `raw_value` in x (N, n, n); the action of the critics is frozen."""
        with torch.no_grad():
            tau, x = self._own(tau, x)
            value = self._critics(tau, x)
            slope = torch.func.grad(lambda y: value(tau, y).mean(0).sum())
            axes = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
            columns = [torch.func.jvp(slope, (x,), (axis.expand_as(x),))[1] for axis in axes]
            return torch.stack(columns, -1)

    def _own(self, tau: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        # With more axes the mean over the critics would be one over points, since critics have an axis before these.
        if x.ndim != 2 or tau.shape != x.shape[:1]:
            raise ArgumentError(
                f"x: expected states (N, n) and times to go (N,), got {(*x.shape,)} and {(*tau.shape,)}"
            )
        return tau.to(self.dtype), self.problem.states.wrap(x.to(self.dtype))

    def _critics(self, tau: Tensor, x: Tensor) -> CriticValue:
        """The critics with the action frozen at that of the policy, which is computed only for critics Q(tau, x, u)."""
        return self.critic.at(self._action(tau, x) if self.critic.action_input else x.new_empty(len(x), 0))

    def _action(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.actor(tau.unsqueeze(-1), x)
