"""One update of the critics, the actor and the target networks: Algorithm 1 of the paper, lines 7 to 13."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from torch import Tensor

from pirl_rl.curriculum import StageSettings
from pirl_rl.errors import ArgumentError, DivergenceError
from pirl_rl.gradients import Gradient, Gradients, Terms
from pirl_rl.internals import FusedSoftUpdate
from pirl_rl.losses import PIRLLoss
from pirl_rl.optimizers import optimizers
from pirl_rl.schedules import WEIGHTS, Weights

EXPLOSION = 1e6
"""A loss above this is a divergence. Errors of probabilities are at most 1, and useful residuals are far smaller."""


class Learner:
    """Updates the networks of a loss.

    Attributes:
        gradients: evaluates the losses and their gradients.
        loss_actor: the loss of the actor's last update, NaN before the first.

    Args:
        loss: the loss, with the critics, the actor and their target networks.
        learning_rate: the initial learning rate, for the critics and the actor.
        optimizer: "adam", or "muon" for the weights between hidden layers, see `pirl_rl.optimizers`.
        decay: "cosine" lowers the learning rate to 0 by (1 + cos(pi t)) / 2 for t from 0 to 1, "constant" keeps it.
        actor_every: the number of critic updates for each update of the actor and the target networks, d_up in the
            paper.
        polyak: the rate, in (0, 1], at which the target networks follow the networks.
        target_warmup: a number w >= 0. The rate of update j of the target networks, counted from 0, is at least
            w/(w + j), so that V travels through the horizon within the first updates.
        compile: whether the losses are compiled. Where that fails, as without a C++ compiler, they run eagerly after
            one warning.

    Raises:
        ArgumentError: a number is out of range, or `decay` or `optimizer` is unknown.
    """

    def __init__(
        self,
        loss: PIRLLoss,
        learning_rate: float = 3e-3,
        optimizer: Literal["adam", "muon"] = "adam",
        decay: Literal["cosine", "constant"] = "cosine",
        actor_every: int = 2,
        polyak: float = 0.005,
        target_warmup: int = 0,
        compile: bool = True,
    ):
        if decay not in ("cosine", "constant"):
            raise ArgumentError(f"learner.decay: expected 'cosine' or 'constant', got {decay!r}")
        if optimizer not in ("adam", "muon"):
            raise ArgumentError(f"learner.optimizer: expected 'adam' or 'muon', got {optimizer!r}")
        if not learning_rate > 0 or actor_every < 1 or not 0 < polyak <= 1:
            raise ArgumentError(
                "learner: expected learning_rate > 0, actor_every >= 1 and 0 < polyak <= 1, "
                f"got {learning_rate}, {actor_every} and {polyak}"
            )
        self.loss = loss
        self.learning_rate, self.decay, self.actor_every = learning_rate, decay, actor_every
        if target_warmup < 0:
            raise ArgumentError(f"learner.target_warmup: expected a number >= 0, got {target_warmup}")
        self.polyak, self.target_warmup = polyak, target_warmup
        self.targets = FusedSoftUpdate(loss, tau=polyak)
        self.critic_optimizers = optimizers(loss.qvalue_network_params, learning_rate, optimizer)
        self.actor_optimizers = optimizers(loss.actor_network_params, learning_rate, optimizer)
        self.train_actor = True
        self.gradients = Gradients(loss, compile)
        self.loss_actor = torch.tensor(math.nan)
        self._moments_rule = _name(loss.actor_rule)

    def apply(self, settings: StageSettings) -> None:
        """Continue with the settings of a stage; a change of the actor rule resets the optimisers of the actor."""
        self.actor_every, self.train_actor = settings.actor_every, settings.train_actor
        self.learning_rate = settings.learning_rate
        if _name(settings.actor_rule) != self._moments_rule:
            # Moments have the scale of one objective's gradient and would misscale steps along another's.
            for optimizer in self.actor_optimizers:
                optimizer.state.clear()
            self._moments_rule = _name(settings.actor_rule)
        if settings.actor_rule is not self.loss.actor_rule:
            self.loss.actor_rule = settings.actor_rule
            self.gradients.make_actor()

    def update(self, batch: TensorDictBase, k: int, weights: Weights, decay: float) -> dict[str, Tensor]:
        """Make one update.

        Args:
            batch: a TensorDict with "replay", "collocation" and "boundary", see `PIRLLoss`, on the device of the
                networks.
            k: the number of the update, counted from 0; the actor and the target networks are updated if it is a
                multiple of `actor_every`.
            weights: (w_TD, w_HJB, w_BC) of the critic loss.
            decay: the progress of the decay of the learning rate, in [0, 1].

        Returns:
            The unweighted terms of the critic loss, and "loss_actor" of the actor's last update.

        Raises:
            DivergenceError: a loss is not finite or too large; the networks are as before the step that it would make.
        """
        self.prepare(weights, decay)
        batch = self.loss.with_noise(batch)
        terms = self.step_critics(self.gradients.critic(batch), k)
        if k % self.actor_every == 0:
            if self.train_actor:
                self.step_actor(self.gradients.actor(batch), k)
            self.step_targets(k)
        return {**terms, "loss_actor": self.loss_actor}

    # The next three are the parts of an update around the losses, which a population evaluates for all its members.

    def prepare(self, weights: Weights, decay: float) -> None:
        """Set the loss weights and the learning rate of an update; arguments are those of `update`."""
        for name, value in zip(WEIGHTS, weights, strict=True):
            setattr(self.loss, name, value)
        for optimizer in (*self.critic_optimizers, *self.actor_optimizers):
            optimizer.param_groups[0]["lr"] = self.rate(decay)

    def step_critics(self, found: Gradient, k: int) -> Terms:
        """Step the critics along the gradient of update `k`; returns the unweighted terms of the loss.

        Raises:
            DivergenceError: the loss is not finite or too large; the networks stay as they are.
        """
        loss, terms, gradient = found
        _check(loss, terms, k + 1)
        _descend(self.critic_optimizers, self.loss.qvalue_network_params, gradient)
        return terms

    def step_actor(self, found: Gradient, k: int) -> None:
        """Step the actor along the gradient of update `k`.

        Raises:
            DivergenceError: the loss is not finite or too large; the networks stay as they are.
        """
        loss, _, gradient = found
        _check(loss, {"loss_actor": loss}, k + 1)
        _descend(self.actor_optimizers, self.loss.actor_network_params, gradient)
        self.loss_actor = loss

    def step_targets(self, k: int) -> None:
        """Move the target networks towards the networks, in update `k`."""
        self.targets.eps = 1 - max(self.polyak, self._early_rate(k // self.actor_every))
        self.targets.step()

    def _early_rate(self, count: int) -> float:
        """The least rate of the target networks after a number of their updates."""
        return self.target_warmup / (self.target_warmup + count) if self.target_warmup else 0.0

    def rate(self, decay: float) -> float:
        """The learning rate at a progress of its decay in [0, 1]."""
        fraction = 1.0 if self.decay == "constant" else (1 + math.cos(math.pi * min(decay, 1.0))) / 2
        return self.learning_rate * fraction

    def check_parameters(self, update: int) -> None:
        """Refuse parameters that are not finite: a finite loss may have had an infinite gradient.

        Raises:
            DivergenceError: a parameter is not finite; the message names it and the update.
        """
        for name, parameter in self.loss.named_parameters():
            if not parameter.isfinite().all():
                raise DivergenceError(f"update {update}: the parameter {name} is not finite")

    def state_dict(self) -> dict[str, Any]:
        return {
            "loss": self.loss.state_dict(),
            "loss_actor": self.loss_actor,
            "actor_rule": self._moments_rule,
            "critic_optimizers": [optimizer.state_dict() for optimizer in self.critic_optimizers],
            "actor_optimizers": [optimizer.state_dict() for optimizer in self.actor_optimizers],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.loss.load_state_dict(state["loss"])
        self.loss_actor, self._moments_rule = state["loss_actor"], state["actor_rule"]
        for name in ("critic_optimizers", "actor_optimizers"):
            if len(own := getattr(self, name)) != len(state[name]):
                raise ArgumentError(
                    f"learner.optimizer: the checkpoint has the state of {len(state[name])} optimisers for each "
                    f"network, expected {len(own)}; its run had another setting"
                )
            for optimizer, saved in zip(own, state[name], strict=True):
                optimizer.load_state_dict(saved)


def _check(loss: Tensor, terms: Terms, update: int) -> None:
    if abs(loss.item()) < EXPLOSION:
        return
    found = ", ".join(f"{name} = {term.item():.3g}" for name, term in terms.items())
    worst = max(terms, key=lambda name: math.inf if math.isnan(value := terms[name].item()) else abs(value))
    raise DivergenceError(f"update {update}: {worst} is not finite or above {EXPLOSION:.0e}: {found}")


def _descend(
    optimizers: Sequence[torch.optim.Optimizer], params: TensorDictParams, gradient: Sequence[Tensor | None]
) -> None:
    """Make a step of each optimiser along the gradient in the parameters."""
    for parameter, entry in zip(params.parameters(), gradient, strict=True):
        # Fused optimisers read a gradient in the order of the memory of its parameter.
        parameter.grad = None if entry is None else entry.contiguous()
    for optimizer in optimizers:
        optimizer.step()


def _name(rule: object) -> str:
    """The full name of the class of a rule, by which a checkpoint records it."""
    return type(rule).__qualname__
