"""One update of the critics, the actor and the target networks: Algorithm 1 of the paper, lines 7 to 13."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from torch import Tensor

from pirl_rl import recording
from pirl_rl.curriculum import StageSettings
from pirl_rl.errors import ArgumentError, DivergenceError
from pirl_rl.gradients import Gradient, Gradients, Terms
from pirl_rl.internals import FusedSoftUpdate
from pirl_rl.losses import PIRLLoss
from pirl_rl.optimizers import optimizers, step_together
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
        actor_polyak: a rate of the target actor of its own, which is at least 1/(1 + j) at its update j, so that the
            target is the mean of the actor's parameters at first. None is the rate of the target critics. A slow
            target suits critics without the action as input, whose targets need no target actor: it is where the
            actor comes to rest, see `settle_actor`.
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
        actor_polyak: float | None = None,
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
        if actor_polyak is not None and not 0 < actor_polyak <= 1:
            raise ArgumentError(f"learner.actor_polyak: expected a number in (0, 1], got {actor_polyak}")
        self.polyak, self.target_warmup, self.actor_polyak = polyak, target_warmup, actor_polyak
        self.target_critics = FusedSoftUpdate(loss, "qvalue_network", polyak)
        self.target_actor = FusedSoftUpdate(loss, "actor_network", polyak)
        device, rate = loss.td_weight.device, learning_rate
        self._largest: Tensor | None = None
        if recording.records(device):
            # What changes from one update to the next lies in memory that stays, for recordings of updates.
            rate = torch.full((), learning_rate, device=device)
            for target in (self.target_critics, self.target_actor):
                target.eps = torch.full((), target.eps, device=device)
            self._largest = torch.zeros((), device=device)
        self.critic_optimizers = optimizers(loss.qvalue_network_params, rate, optimizer)
        self.actor_optimizers = optimizers(loss.actor_network_params, rate, optimizer)
        self._prepared: dict[str, float] = {}
        self.train_actor = True
        self.gradients = Gradients(loss, compile)
        self.loss_actor = torch.full((), math.nan, device=device)
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
                On a GPU `check` finds it.
        """
        self.prepare(weights, decay, k)
        return self.make(batch, k)

    def make(self, batch: TensorDictBase, k: int) -> dict[str, Tensor]:
        """Make an update that is prepared; arguments, results and errors are those of `update`."""
        batch = self.loss.with_noise(batch)
        terms = self.lead_critics(self.gradients.critic(batch), k)
        step_together(self.critic_optimizers)
        if k % self.actor_every == 0:
            if self.train_actor:
                self.lead_actor(self.gradients.actor(batch), k)
                step_together(self.actor_optimizers)
            self.step_targets()
        return {**terms, "loss_actor": self.loss_actor}

    # The next four are the parts of an update around the losses, which a population evaluates for all its members.

    def prepare(self, weights: Weights, decay: float, k: int) -> None:
        """Set the loss weights, the learning rate and the rate of the targets; arguments are those of `update`."""
        numbers = dict(zip(WEIGHTS, weights, strict=True))
        critics, actor = self._target_rates(k // self.actor_every)
        numbers |= {"learning_rate": self.rate(decay), "target_critics": 1 - critics, "target_actor": 1 - actor}
        for name, value in numbers.items():
            if self._prepared.get(name) != value:
                self._set(name, value)
        self._prepared = numbers

    def _set(self, name: str, value: float) -> None:
        if name in WEIGHTS:
            setattr(self.loss, name, value)
        elif name in ("target_critics", "target_actor"):
            target = getattr(self, name)
            target.eps = recording.renewed(target.eps, value)
        else:
            for optimizer in (*self.critic_optimizers, *self.actor_optimizers):
                group = optimizer.param_groups[0]
                group["lr"] = recording.renewed(group["lr"], value)

    def lead_critics(self, found: Gradient, k: int) -> Terms:
        """Give the critics the gradient of update `k`, for a step of `critic_optimizers`.

        Returns:
            The unweighted terms of the loss.

        Raises:
            DivergenceError: the loss is not finite or too large. On a GPU `check` finds it.
        """
        loss, terms, gradient = found
        self._judge(loss, terms, k + 1)
        _lead(self.loss.qvalue_network_params, gradient)
        return terms

    def lead_actor(self, found: Gradient, k: int) -> None:
        """Give the actor the gradient of update `k`, for a step of `actor_optimizers`.

        Raises:
            DivergenceError: the loss is not finite or too large. On a GPU `check` finds it.
        """
        loss, _, gradient = found
        self._judge(loss, {"loss_actor": loss}, k + 1)
        _lead(self.loss.actor_network_params, gradient)
        self.loss_actor.copy_(loss)

    def step_targets(self) -> None:
        """Move the target networks towards the networks."""
        self.target_critics.step()
        self.target_actor.step()

    def settle_actor(self) -> None:
        """Put the target actor, a mean over the last updates, in the place of the actor.

        Where two controls are worth nearly the same, the surface at which the policy changes from one to the other
        moves to and fro from update to update. The last actor may have it at either end, and the mean in the middle.
        """
        self.loss.actor_network_params.data.update_(self.loss.target_actor_network_params.data)

    def _target_rates(self, count: int) -> tuple[float, float]:
        """The rates of the target critics and of the target actor after a number of their updates."""
        early = self.target_warmup / (self.target_warmup + count) if self.target_warmup else 0.0
        critics = max(self.polyak, early)
        return critics, critics if self.actor_polyak is None else max(self.actor_polyak, 1 / (1 + count))

    def rate(self, decay: float) -> float:
        """The learning rate at a progress of its decay in [0, 1]."""
        fraction = 1.0 if self.decay == "constant" else (1 + math.cos(math.pi * min(decay, 1.0))) / 2
        return self.learning_rate * fraction

    def _judge(self, loss: Tensor, terms: Terms, update: int) -> None:
        """Refuse a loss at once, or on a GPU, which works ahead of Python, note it for `check`."""
        if self._largest is None:
            _check(loss, terms, update)
        else:
            size = loss.detach().abs().nan_to_num(nan=math.inf, posinf=math.inf)
            torch.maximum(self._largest, size, out=self._largest)

    def check(self, update: int) -> None:
        """Refuse losses and parameters that are not finite: a finite loss may have had an infinite gradient.

        Raises:
            DivergenceError: a loss since the last check is not finite or too large, or a parameter is not finite; the
                message names it and the update.
        """
        if self._largest is not None:
            if not self._largest.item() < EXPLOSION:
                raise DivergenceError(f"update {update}: a loss is not finite or above {EXPLOSION:.0e}")
            self._largest.zero_()
        finite = {name: parameter.isfinite().all() for name, parameter in self.loss.named_parameters()}
        if not torch.stack(list(finite.values())).all():  # one question to the device for all of them
            spoilt = next(name for name, whole in finite.items() if not whole)
            raise DivergenceError(f"update {update}: the parameter {spoilt} is not finite")

    def state_dict(self) -> dict[str, Any]:
        return {
            "loss": self.loss.state_dict(),
            "loss_actor": self.loss_actor,
            "actor_rule": self._moments_rule,
            "critic_optimizers": [_state(optimizer) for optimizer in self.critic_optimizers],
            "actor_optimizers": [_state(optimizer) for optimizer in self.actor_optimizers],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.loss.load_state_dict(state["loss"])
        self.loss_actor.copy_(state["loss_actor"])
        self._moments_rule = state["actor_rule"]
        for name in ("critic_optimizers", "actor_optimizers"):
            if len(own := getattr(self, name)) != len(state[name]):
                raise ArgumentError(
                    f"learner.optimizer: the checkpoint has the state of {len(state[name])} optimisers for each "
                    f"network, expected {len(own)}; its run had another setting"
                )
            for optimizer, saved in zip(own, state[name], strict=True):
                optimizer.load_state_dict(saved | {"param_groups": _adapted(optimizer, saved["param_groups"])})
        self._prepared = {}


def _check(loss: Tensor, terms: Terms, update: int) -> None:
    if abs(loss.item()) < EXPLOSION:
        return
    found = ", ".join(f"{name} = {term.item():.3g}" for name, term in terms.items())
    worst = max(terms, key=lambda name: math.inf if math.isnan(value := terms[name].item()) else abs(value))
    raise DivergenceError(f"update {update}: {worst} is not finite or above {EXPLOSION:.0e}: {found}")


def _lead(params: TensorDictParams, gradient: Sequence[Tensor | None]) -> None:
    """Give parameters their gradient."""
    for parameter, entry in zip(params.parameters(), gradient, strict=True):
        # Fused optimisers read a gradient in the order of the memory of its parameter.
        parameter.grad = None if entry is None else entry.contiguous()


def _state(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """The state of an optimiser, with the learning rate as a number on all devices."""
    state = optimizer.state_dict()
    return state | {"param_groups": [group | {"lr": float(group["lr"])} for group in state["param_groups"]]}


def _adapted(optimizer: torch.optim.Optimizer, saved: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Saved settings of an optimiser, which may come from another device, for the device of this one."""
    groups = []
    for own, group in zip(optimizer.param_groups, saved, strict=True):
        device_settings = {"capturable": own["capturable"]} if "capturable" in own else {}
        groups.append({**group, **device_settings, "lr": recording.renewed(own["lr"], group["lr"])})
    return groups


def _name(rule: object) -> str:
    """The full name of the class of a rule, by which a checkpoint records it."""
    return type(rule).__qualname__
