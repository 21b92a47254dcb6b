"""The learner: one update of critics, actor and targets, Algorithm 1 of the paper, lines 7 to 13."""

from __future__ import annotations

import math
import warnings
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch._dynamo.exc import BackendCompilerFailed
from torchrl.objectives import SoftUpdate

from pirl_rl.curriculum import Settings
from pirl_rl.errors import ArgumentError, DivergenceError
from pirl_rl.losses import PIRLLoss
from pirl_rl.schedules import Schedule

EXPLOSION = 1e6
"""A critic loss above this is a divergence: probabilities err by at most 1, and residuals of interest are far below."""


class Learner:
    """Optimises a loss.

    Args:
        loss: critics, actor and their targets.
        schedule: weights of the critic terms by update.
        learning_rate: Adam's rate at the first update, for critics and actor.
        decay: "cosine" lets the rate fall to zero along a quarter wave, "constant" keeps it.
        actor_every: critic updates for each update of the actor and the targets (d_up).
        polyak: rate of the targets.
        compile: compile the losses; where that fails, as without a C++ compiler, they run eagerly after one warning.
    """

    def __init__(
        self,
        loss: PIRLLoss,
        schedule: Schedule,
        learning_rate: float = 1e-3,
        decay: Literal["cosine", "constant"] = "cosine",
        actor_every: int = 2,
        polyak: float = 0.005,
        compile: bool = True,
    ):
        if decay not in ("cosine", "constant"):
            raise ArgumentError(f"learner.decay: expected 'cosine' or 'constant', got {decay!r}")
        if not learning_rate > 0 or actor_every < 1 or not 0 < polyak <= 1:
            raise ArgumentError(
                "learner: expected learning_rate > 0, actor_every >= 1 and 0 < polyak <= 1, "
                f"got {learning_rate}, {actor_every} and {polyak}"
            )
        self.loss, self.schedule = loss, schedule
        self.learning_rate, self.decay, self.actor_every = learning_rate, decay, actor_every
        self.targets = SoftUpdate(loss, tau=polyak)
        self.critic_optimizer = _adam(loss.qvalue_network_params, learning_rate)
        self.actor_optimizer = _adam(loss.actor_network_params, learning_rate)
        self.train_actor = True
        self.compile = compile
        if compile:
            for name in loss.compilable:
                setattr(loss, name, torch.compile(getattr(loss, name)))
        self._loss_actor = torch.tensor(math.nan)

    def begin(self, settings: Settings) -> None:
        """Go on as a stage of a curriculum asks."""
        self.actor_every, self.train_actor = settings.actor_every, settings.train_actor
        self.learning_rate = settings.learning_rate
        if settings.actor_rule != self.loss.actor_rule:
            # Adam's moments of one objective are the wrong scale for another's first steps.
            self.actor_optimizer.state.clear()
        self.loss.actor_rule, self.loss.model_steps = settings.actor_rule, settings.model_steps
        self.loss.exploration_noise = settings.exploration_noise

    def update(self, batch: TensorDictBase, k: int, progress: float) -> dict[str, Tensor]:
        """The k-th update (from 0) on {"replay", "collocation", "boundary"}; returns the unweighted terms.

        "loss_actor" is that of the actor's last update.

        Args:
            progress: how far the learning rate's course is, from 0 to 1.

        Raises:
            DivergenceError: before the step that would have spoilt the networks.
        """
        self._set_weights_and_rate(k, progress)
        loss, terms = self._evaluate("critic_loss", batch)
        self._check(loss, terms, k + 1)
        self._step(self.critic_optimizer, loss)
        if k % self.actor_every == 0:
            if self.train_actor:
                loss_actor, _ = self._evaluate("actor_loss", batch)
                self._check(loss_actor, {"loss_actor": loss_actor}, k + 1)
                self._step(self.actor_optimizer, loss_actor)
                self._loss_actor = loss_actor.detach()
            self.targets.step()
        return {**terms, "loss_actor": self._loss_actor}

    def check_parameters(self, update: int) -> None:
        """Refuse networks that are spoilt already: a finite loss may have had a gradient that is not.

        Raises:
            DivergenceError: with the update and the parameter.
        """
        for name, parameter in self.loss.named_parameters():
            if not parameter.isfinite().all():
                raise DivergenceError(f"update {update}: {name} is not finite")

    def weights_and_rate(self, k: int, progress: float) -> dict[str, float]:
        """The loss weights and the learning rate of the k-th update."""
        td, hjb, boundary = self.schedule(k)
        fraction = 1.0 if self.decay == "constant" else (1 + math.cos(math.pi * min(progress, 1.0))) / 2
        return {
            "td_weight": td,
            "hjb_weight": hjb,
            "boundary_weight": boundary,
            "learning_rate": self.learning_rate * fraction,
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            "loss": self.loss.state_dict(),
            "loss_actor": self._loss_actor,
            "actor_rule": self.loss.actor_rule,
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.loss.load_state_dict(state["loss"])
        self._loss_actor, self.loss.actor_rule = state["loss_actor"], state["actor_rule"]
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])

    def _set_weights_and_rate(self, k: int, progress: float) -> None:
        values = self.weights_and_rate(k, progress)
        rate = values.pop("learning_rate")
        for name, value in values.items():
            setattr(self.loss, name, value)
        for optimizer in (self.critic_optimizer, self.actor_optimizer):
            optimizer.param_groups[0]["lr"] = rate

    def _evaluate(self, name: str, batch: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """A loss of the module, compiled where that works."""
        try:
            return getattr(self.loss, name)(batch)
        except BackendCompilerFailed as error:
            if not self.compile:
                raise
            self.compile = False
            for compiled in self.loss.compilable:
                delattr(self.loss, compiled)
            reason = str(error).partition("\n")[0]
            warnings.warn(f"updates run eagerly, about half as fast: {reason}", stacklevel=3)
            return getattr(self.loss, name)(batch)

    @staticmethod
    def _step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    @staticmethod
    def _check(loss: Tensor, terms: dict[str, Tensor], update: int) -> None:
        if abs(loss.item()) < EXPLOSION:
            return
        found = ", ".join(f"{name} = {term.item():.3g}" for name, term in terms.items())
        worst = max(terms, key=lambda name: math.inf if math.isnan(value := terms[name].item()) else abs(value))
        raise DivergenceError(f"update {update}: {worst} is not finite or exploded (above {EXPLOSION:.0e}): {found}")


def _adam(params, rate: float) -> torch.optim.Adam:
    return torch.optim.Adam(list(params.parameters()), rate, fused=True)
