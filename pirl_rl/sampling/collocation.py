"""Collocation: interior points (tau, x) at which the HJB residual enters the loss.

The number of points of a sample is fixed, so that an update has static shapes: points inside A or B, or with tau
outside (0, T], are masked in place of being dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem


class Collocation:
    """Samples points (tau, x) of the box (0, T] x states.

    Args:
        problem: gives the box and the mask.
        size: the number of points of a sample.
        sampler: "uniform" for independent points, or "sobol" for scrambled low-discrepancy points.
        widen: the widths of the box of states are multiplied by this factor.
        tau_power: tau = T U^tau_power with U uniform; 1 is uniform, 2 gives more points near tau = 0, where V is steep.

    Raises:
        ArgumentError: a number is out of range, or `sampler` is unknown.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        size: int = 300,
        sampler: Literal["uniform", "sobol"] = "uniform",
        widen: float = 1.0,
        tau_power: float = 2.0,
    ):
        if sampler not in ("uniform", "sobol"):
            raise ArgumentError(f"collocation.sampler: expected 'uniform' or 'sobol', got {sampler!r}")
        if size < 1 or not widen > 0 or not tau_power > 0:
            raise ArgumentError(
                f"collocation: expected size >= 1, widen > 0, tau_power > 0, got {size}, {widen}, {tau_power}"
            )
        self.problem, self.size, self.sampler, self.tau_power = problem, size, sampler, tau_power
        self.box = problem.states.expand(widen)

    def sample(
        self, rng: torch.Generator, replay: TensorDictBase | None = None, progress: float | Tensor = 0.0
    ) -> TensorDict:
        """Draw points.

        Args:
            rng: the random generator, on whose device the points are.
            replay: the transitions of the update, with "tau" and "state", for samplers that stay near visited states.
            progress: the progress of the loss schedule in [0, 1], a scalar, for samplers that change with it.

        Returns:
            A TensorDict with "tau" (size, 1), in s, "state" (size, n) and "mask" (size,), see `mask`.
        """
        unit = self._unit(rng)
        # 1 - U lies in (0, 1]: tau = 0 belongs to the boundary.
        tau = self.problem.horizon * (1 - unit[:, :1]) ** self.tau_power
        state = self.box.wrap(self.box.denormalize(2 * unit[:, 1:] - 1))
        return TensorDict({"tau": tau, "state": state, "mask": self.mask(tau, state)}, batch_size=[self.size])

    def mask(self, tau: Tensor, state: Tensor) -> Tensor:
        """Whether Eq. (hjb_pde) is imposed at tau (N, 1) and state (N, n), (N,) bool; not where V is known."""
        t = tau.squeeze(-1)
        known = ~self.problem.interior(state) | self.problem.unreachable(state)
        return ~known & (t > 0) & (t <= self.problem.horizon)

    def _unit(self, rng: torch.Generator) -> Tensor:
        dim = 1 + self.box.dim
        if self.sampler == "uniform":
            return torch.rand(self.size, dim, generator=rng, device=rng.device)
        seed = int(torch.randint(2**31, (), generator=rng, device=rng.device))
        engine = torch.quasirandom.SobolEngine(dim, scramble=True, seed=seed)
        return engine.draw(self.size).to(rng.device)


class ReplayCollocation(Collocation):
    """Samples a share of the points near those that the policy visits, and the others as `Collocation` does.

    In many dimensions the policy visits only a small part of the box. Visited points (tau, x) are moved by independent
    normal steps in the coordinates in which (0, T] x states is [-1, 1]^(1 + n). The share of these points and the size
    of the steps change with the loss schedule, as between the transition and the refinement stage of the paper.

    Args:
        problem, size, sampler, widen, tau_power: arguments of `Collocation`, for the other points.
        replay_share: the share of points near visited ones, at the start and at the end of the schedule.
        jitter: the standard deviation of the steps, at the start and at the end of the schedule.

    Raises:
        ArgumentError: a number is out of range, or `sampler` is unknown.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        size: int = 300,
        sampler: Literal["uniform", "sobol"] = "uniform",
        widen: float = 1.0,
        tau_power: float = 2.0,
        replay_share: Sequence[float] = (1.0, 1.0),
        jitter: Sequence[float] = (0.0, 0.0),
    ):
        super().__init__(problem, size, sampler, widen, tau_power)
        for name, ends, most in (("replay_share", replay_share, 1.0), ("jitter", jitter, float("inf"))):
            if len(ends) != 2 or not all(0 <= end <= most for end in ends):
                raise ArgumentError(f"collocation.{name}: expected [start, end] from 0 to {most:g}, got {list(ends)}")
        self.replay_share, self.jitter = tuple(replay_share), tuple(jitter)

    def sample(
        self, rng: torch.Generator, replay: TensorDictBase | None = None, progress: float | Tensor = 0.0
    ) -> TensorDict:
        rest = super().sample(rng, replay, progress)
        if replay is None:
            return rest
        share, jitter = (start + (end - start) * progress for start, end in (self.replay_share, self.jitter))
        device, horizon = rng.device, self.problem.horizon
        index = torch.randint(len(replay), (self.size,), generator=rng, device=device)
        step = jitter * torch.randn(self.size, 1 + self.problem.states.dim, generator=rng, device=device)
        # tau is reflected at both ends of (0, T], as often as it takes: the critic takes its root, and NaN would reach
        # the gradient even from a masked point.
        tau = (replay["tau"][index] + step[:, :1] * horizon / 2).remainder(2 * horizon)
        tau = horizon - torch.abs(horizon - tau)
        states = self.problem.states
        state = states.wrap(states.denormalize(states.normalize(replay["state"][index]) + step[:, 1:]))
        taken = torch.rand(self.size, 1, generator=rng, device=device) < share
        tau, state = torch.where(taken, tau, rest["tau"]), torch.where(taken, state, rest["state"])
        return TensorDict({"tau": tau, "state": state, "mask": self.mask(tau, state)}, batch_size=[self.size])
