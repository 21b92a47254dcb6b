"""A learned solution: the value V(tau, x), the policy that should attain it, and the residual of V."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.losses import PIRLLoss


class Solution:
    """What the networks of a loss say: V is the mean of the critics at u = pi(tau, x).

    tau (N,) in s, x (N, n) in SI units; answers are in the networks' dtype.
    """

    def __init__(self, loss: PIRLLoss):
        self.loss, self.problem = loss, loss.problem

    @property
    def dtype(self) -> torch.dtype:
        return next(self.loss.parameters()).dtype

    @property
    def device(self) -> torch.device:
        return next(self.loss.parameters()).device

    @torch.no_grad()
    def policy(self, tau: Tensor, x: Tensor) -> Tensor:
        """The physical control (N, m)."""
        return self.problem.controls.denormalize(self._action(*self._own(tau, x)))

    @torch.no_grad()
    def raw_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """The networks' own V (N,), with no knowledge of the sets."""
        tau, x = self._own(tau, x)
        with self.loss.critics() as critic:
            return critic.at(self._action(tau, x))(tau, x).mean(0)

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
        return self.loss.residuals(tau, x, action, self.problem.controls.denormalize(action) if u is None else u).mean(
            0
        )

    def gradient(self, tau: Tensor, x: Tensor) -> Tensor:
        """grad_x of `raw_value` (N, n), the critics' action frozen at the policy."""
        tau, x = self._own(tau, x)
        action = self._action(tau, x).detach()
        x = x.detach().requires_grad_()
        with self.loss.critics("frozen") as critic:
            value = critic.at(action)(tau, x).mean(0)
        return torch.autograd.grad(value.sum(), x)[0]

    def _own(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(tensor.to(self.dtype) for tensor in tensors)

    def _action(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.loss.act(tau.unsqueeze(-1), x)
