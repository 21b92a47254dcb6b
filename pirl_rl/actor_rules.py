"""What the actor ascends: each rule is one objective of `PIRLLoss`, a mean over transitions or collocation points.

A rule takes the loss, transitions (tau, state, action, loc, next) and points (tau, state, and a mask where some do not
count). No gradient reaches the critics. y is (tau, x), a prime marks what follows a transition, V is the mean of the
critics at the actor's output.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Critic
from pirl_rl.operators import masked_mean
from pirl_rl.simulator import Simulator

if TYPE_CHECKING:
    from pirl_rl.losses import PIRLLoss

ActorRule = Literal["q", "hamiltonian", "both", "model", "ppo"]


def q(loss: PIRLLoss, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
    """Q_1(y, pi(y)), Eq. (actor_loss)."""
    tau, x = replay["tau"], replay["state"]
    action = loss.act(tau, x)
    with loss.critics("frozen") as critic:
        return critic(tau, x, action)[0].mean()


def hamiltonian(loss: PIRLLoss, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
    """f(x, u) . grad V + 1/2 Tr(sigma sigma^T hess V), Eq. (generator).

    V is the mean critic at the frozen action; u is the actor's output with its gradient. The second term is left out
    where it does not depend on u.
    """
    tau, x = points["tau"], points["state"]
    action = loss.act(tau, x)
    u = loss.problem.controls.denormalize(action)
    with loss.critics("frozen") as critic:
        value = loss.hamiltonian_operator(critic.at(action.detach()), loss.problem, tau.squeeze(-1), x, u).mean(0)
    mask = points["mask"] if "mask" in points.keys() else torch.ones_like(value, dtype=torch.bool)
    return masked_mean(value, mask)


def both(loss: PIRLLoss, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
    """The sum of `q` and `hamiltonian`."""
    return q(loss, replay, points) + hamiltonian(loss, replay, points)


def model(loss: PIRLLoss, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
    """V at the end of `model_steps` noise-free control steps, or where they meet A or B: what the Hamiltonian becomes
    where a control is held."""
    assert loss.simulator is not None
    tau, x, dt = replay["tau"], replay["state"], loss.simulator.dt
    for _ in range(loss.model_steps):
        # Half a step of tolerance: tau is a whole number of steps up to rounding.
        live = loss.problem.interior(x).unsqueeze(-1) & (tau > dt / 2)
        moved = loss.flow(x, loss.problem.controls.denormalize(loss.act(tau, x)))
        tau, x = torch.where(live, tau - dt, tau), torch.where(live, moved, x)
    with loss.critics("frozen") as critic:
        value = critic(tau, x, loss.act(tau, x).detach()).mean(0).squeeze(-1)
    return torch.where(loss.problem.reached(x), torch.ones_like(value), value).mean()


def ppo(loss: PIRLLoss, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
    """min(rho A, clip(rho) A), the clipped surrogate of Schulman et al. 2017, arXiv:1707.06347.

    rho is the ratio of the densities of the played action under pi and under the policy that played it, Gaussians of
    deviation `exploration_noise` around the actor's output, their cut at -1 and 1 neglected; A = r + (1 - d) V(y') -
    V(y), in units of its deviation over the batch. Unlike the other rules it sees the advantage of what was really
    played, noise, exits and all, and not a slope of V. It wants noise on every action, `collector.exploration=always`.
    """
    tau, x, played = replay["tau"], replay["state"], replay["action"]
    following: TensorDictBase | None = replay.get("next", None)
    if following is None:
        raise ArgumentError("loss.actor_rule: 'ppo' follows returns, expected a weight of the TD loss above 0")
    with torch.no_grad(), loss.critics("frozen") as critic:
        here, there = (
            critic(t, y, loss.act(t, y)).mean(0) for t, y in ((tau, x), (following["tau"], following["state"]))
        )
    advantage = (following["reward"] + (~following["terminated"]) * there - here).squeeze(-1)
    advantage = advantage / advantage.std().clamp(min=torch.finfo(advantage.dtype).eps)
    old, new = ((played - center).square().sum(-1) for center in (replay["loc"], loss.act(tau, x)))
    ratio = ((old - new) / (2 * loss.exploration_noise**2)).exp()
    clipped = ratio.clamp(1 - loss.ppo_clip, 1 + loss.ppo_clip)
    return torch.minimum(ratio * advantage, clipped * advantage).mean()


ACTOR_RULES: dict[ActorRule, Callable[[PIRLLoss, TensorDictBase, TensorDictBase], Tensor]] = {
    "q": q,
    "hamiltonian": hamiltonian,
    "both": both,
    "model": model,
    "ppo": ppo,
}


def check_rule(rule: ActorRule, critic: Critic, simulator: Simulator | None, exploration_noise: float) -> None:
    """Refuse a rule that lacks what it needs.

    Raises:
        ValueError: naming it.
    """
    if rule not in ACTOR_RULES:
        raise ArgumentError(f"loss.actor_rule: expected one of {', '.join(ACTOR_RULES)}, got {rule!r}")
    if rule in ("q", "both") and not critic.action_input:
        raise ArgumentError(
            f"loss.actor_rule: critics without the action need 'hamiltonian', 'model' or 'ppo', got {rule!r}"
        )
    if rule == "ppo" and critic.action_input:
        raise ArgumentError(
            "loss.actor_rule: 'ppo' takes advantages over V(tau, x), expected critics without the action"
        )
    if rule == "model" and simulator is None:
        raise ArgumentError("loss.simulator: expected a simulator for actor_rule 'model', got none")
    if rule == "ppo" and not exploration_noise > 0:
        raise ArgumentError(
            f"collector.exploration_noise: expected noise > 0 for actor_rule 'ppo', got {exploration_noise}"
        )
