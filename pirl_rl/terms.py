"""The three terms of the critic loss, one class each: temporal differences, the HJB residual and the boundary values.

A term maps the networks, its part of a batch and the random numbers that it drew before to a loss, which is a sum over
the critics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Actor, Critic
from pirl_rl.operators import generator, masked_mean, rademacher
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.structure import noise_channels

TD_CRITERIA = ("squares", "cross_entropy")

LARGEST_LOGIT = 10.0
"""Logits of V beyond this, at which V is 5e-5 away from 0 or 1, are held back."""

LOGIT_WEIGHT = 0.1
"""The weight of the square of what a logit exceeds that by."""

_cross_entropy = nn.functional.binary_cross_entropy_with_logits


class Networks(NamedTuple):
    """What the losses evaluate: the networks, where one module has the parameters of all critics, and the weights.

    The frozen critic has the parameters of the critic, without gradients; the weights are (w_TD, w_HJB, w_BC).
    """

    critic: Critic
    frozen_critic: Critic
    target_critic: Critic
    actor: Actor
    target_actor: Actor
    weights: Sequence[Tensor]


class TemporalDifferences:
    """L_TD: the mean of (Q_i - r - (1 - d) min_j Q_j^-(y', pi^-(y') + noise))^2 over transitions, summed over critics.

    Args:
        criterion, target_critics, noise, noise_clip: the arguments `td_criterion`, `target_critics`, `policy_noise` and
            `noise_clip` of `pirl_rl.losses.PIRLLoss`.

    Raises:
        ArgumentError: `criterion` or `target_critics` is unknown.
    """

    def __init__(
        self,
        criterion: Literal["squares", "cross_entropy"],
        target_critics: Literal["min", "mean"],
        noise: float,
        noise_clip: float,
    ):
        if criterion not in TD_CRITERIA:
            raise ArgumentError(f"loss.td_criterion: expected one of {', '.join(TD_CRITERIA)}, got {criterion!r}")
        if target_critics not in ("min", "mean"):
            raise ArgumentError(f"loss.target_critics: expected 'min' or 'mean', got {target_critics!r}")
        self.criterion, self.target_critics, self.noise, self.noise_clip = criterion, target_critics, noise, noise_clip

    def draw(self, action: Tensor) -> dict[str, Tensor]:
        """The smoothing noise for played actions (N, m)."""
        return {"smoothing": _clipped_noise(action, self.noise, self.noise_clip)} if self.noise else {}

    def __call__(self, networks: Networks, replay: TensorDictBase, noise: TensorDictBase) -> Tensor:
        following: TensorDictBase = replay.get("next")
        action = target_action(networks, following)
        if self.noise:
            action = (action + noise["smoothing"]).clamp(-1, 1)
        with torch.no_grad():
            values = networks.target_critic(following["tau"], following["state"], action)
            value = values.amin(0) if self.target_critics == "min" else values.mean(0)
            # A path may have ended where V has no number.
            target = following["reward"] + torch.where(following["terminated"], 0.0, value)
        inputs = replay["tau"], replay["state"], replay["action"]
        if self.criterion == "squares":
            error = (networks.critic(*inputs) - target).square()
        else:
            # Targets may lie outside [0, 1] by a control variate. The loss is linear in them, so that their mean
            # counts, and from the logits it has a gradient where the output is rounded to 0 or 1.
            # Without a bound a network that tells single targets apart would follow them to infinity.
            logits = networks.critic.logits(*inputs)
            error = _cross_entropy(logits, target.expand_as(logits), reduction="none")
            error = error + LOGIT_WEIGHT * (logits.abs() - LARGEST_LOGIT).clamp(min=0).square()
        return error.squeeze(-1).sum(0).mean()


class HJBResidual:
    """L_PDE: the mean of (t L^u Q_i)^2 over unmasked points with u = pi^-(y) + noise, summed over critics.

    Args:
        problem: the physics.
        noise, noise_clip, time, delta, probes: the arguments `hjb_noise`, `hjb_noise_clip`, `hjb_time`, `hjb_delta` and
            `hjb_probes` of `pirl_rl.losses.PIRLLoss`; t is `time`.

    Raises:
        ArgumentError: `time` is not positive, or `probes` is negative or 1.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        noise: float,
        noise_clip: float,
        time: float,
        delta: float | None,
        probes: int,
    ):
        if not 0 < time < math.inf:
            raise ArgumentError(f"loss.hjb_time: expected a finite number > 0, in s, or auto, got {time}")
        if probes < 0 or probes == 1:
            raise ArgumentError(
                "loss.hjb_probes: expected 0 for the exact trace, or at least 2, since the square of a residual needs "
                f"two independent estimates, got {probes}"
            )
        self.problem, self.channels = problem, noise_channels(problem)
        self.noise, self.noise_clip, self.time, self.delta, self.probes = noise, noise_clip, time, delta, probes

    def draw(self, x: Tensor) -> dict[str, Tensor]:
        """The noise on the action, and the probes of the trace, for points x (N, n)."""
        drawn = {}
        if self.noise:
            like = x[:, :1].expand(-1, self.problem.controls.dim)
            drawn["control"] = _clipped_noise(like, self.noise, self.noise_clip)
        if self.probes:
            drawn["probes"] = rademacher(self.probes, x, self.channels)
            if self.delta is not None:
                drawn["probes_of_size"] = rademacher(self.probes, x, self.channels)
        return drawn

    def __call__(self, networks: Networks, points: TensorDictBase, noise: TensorDictBase) -> Tensor:
        action = target_action(networks, points)
        if self.noise:
            action = (action + noise["control"]).clamp(-1, 1)
        if self.probes:
            squares = self._estimated_squares(networks, points, action, noise)
        else:
            squares = _huber(self.residuals(networks, points, action), self.delta)
        return masked_mean(squares.sum(0), points["mask"])

    def residuals(
        self, networks: Networks, points: TensorDictBase, action: Tensor, probes: Tensor | None = None
    ) -> Tensor:
        """t L^u Q_i(., action) (critics, N), with the critics' action (N, m) frozen and u = action in physical units.

        With probes (k, N, w) there are k estimates of each, (critics, k, N).
        """
        tau, x, u = points["tau"].squeeze(-1), points["state"], self.problem.controls.denormalize(action)
        return self.time * generator(networks.critic.at(action), self.problem, tau, x, u, probes)

    def _estimated_squares(
        self, networks: Networks, points: TensorDictBase, action: Tensor, noise: TensorDictBase
    ) -> Tensor:
        """Unbiased estimates (critics, N) of r^2 for the residuals r of `residuals`, from k independent probes.

        The square of the mean of the k estimates of r has the mean r^2 + Var/k, from which the sample variance over k
        is subtracted. For two probes what is left is the product r_1 r_2.

        Huber's loss is a concave function H of r^2. With a delta the result is the tangent of H at the mean square
        r_0^2 of k more estimates, which take no gradient: H(r_0^2) + H'(r_0^2) (r_1 r_2 - r_0^2). On average its
        gradient is that of r^2 times the weight E H'(r_0^2), which is at most 1 and falls with r. If r_0 came from the
        same probes, the loss would fall as the variance of the estimates grows.
        """
        estimates = self.residuals(networks, points, action, noise["probes"])
        square = estimates.mean(-2).square() - estimates.var(-2) / self.probes
        if self.delta is None:
            return square
        with torch.no_grad():
            of_size = self.residuals(networks, points, action, noise["probes_of_size"])
            size = of_size.square().mean(-2).sqrt()
        slope = (self.delta / size).clamp(max=1)
        return _huber(size, self.delta) + slope * (square - size.square())


class BoundaryValues:
    """L_BC: the mean of w (Q_i(y, pi^-(y)) - l_eps)^2 with the weights w of the points, summed over critics.

    Args:
        delta: the argument `boundary_delta` of `pirl_rl.losses.PIRLLoss`.
    """

    def __init__(self, delta: float | None):
        self.delta = delta

    def __call__(self, networks: Networks, points: TensorDictBase) -> Tensor:
        action = target_action(networks, points)
        value = networks.critic(points["tau"], points["state"], action).squeeze(-1)
        return (points["weight"] * _huber(value - points["value"], self.delta).sum(0)).mean()


def target_action(networks: Networks, points: TensorDictBase) -> Tensor:
    """The output (N, m) in [-1, 1] of the target actor, without a gradient."""
    with torch.no_grad():
        return networks.target_actor(points["tau"], points["state"])


def _clipped_noise(like: Tensor, deviation: float, bound: float) -> Tensor:
    return (torch.randn_like(like) * deviation).clamp(-bound, bound)


def _huber(residual: Tensor, delta: float | None) -> Tensor:
    """r^2, and where |r| exceeds a given delta, 2 delta |r| - delta^2."""
    if delta is None:
        return residual.square()
    return 2 * nn.functional.huber_loss(residual, torch.zeros_like(residual), reduction="none", delta=delta)
