"""The PIRL loss, Sec. IV-A of the paper: temporal differences, the HJB residual and the boundary in one module.

    L_critic = sum_i  w_TD L_TD,i + w_HJB L_PDE,i + w_BC L_BC,i                     Eq. (critic_loss)

over the critics i. The HJB residual differentiates Q(tau, x, u) with u frozen at the output of the target actor. The
weights are buffers: `loss.hjb_weight = 0.3` changes one in place, also for compiled code, and a checkpoint keeps it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from pirl_rl.actor_rules import ActorRule
from pirl_rl.errors import ArgumentError
from pirl_rl.internals import ScheduledTD3Loss
from pirl_rl.networks import Actor, Critic
from pirl_rl.operators import require_twice_differentiable
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.schedules import WEIGHTS
from pirl_rl.solution import Solution
from pirl_rl.terms import BoundaryValues, HJBResidual, Networks, TemporalDifferences

TERMS = ("td_loss", "hjb_loss", "boundary_loss")
"""The names of the terms of the critic loss, in the order of their weights."""


class PIRLLoss(ScheduledTD3Loss):
    """TD3 targets with collocation HJB and boundary terms.

    `forward` takes a TensorDict with up to three parts, and each term of the critic loss is there if its part is:

    - "replay": N transitions with "tau" (N, 1), "state" (N, n), "action" (N, m) and, for the TD term, "next";
    - "collocation": "tau" (N, 1), "state" (N, n) and "mask" (N,), for the HJB term;
    - "boundary": "tau" (N, 1), "state" (N, n), "value" (N,) and "weight" (N,), for the boundary term.

    It returns the scalars "loss_qvalue" and "loss_actor", for the two optimisers, and the unweighted "td_loss",
    "hjb_loss" and "boundary_loss", which are sums over the critics.

    Args:
        problem: the physics.
        actor: pi(tau, x).
        critics: two for TD3; one, with `policy_noise=0`, is DDPG's critic rule.
        actor_rule: what the actor ascends, see `pirl_rl.actor_rules`; a stage of training may replace it.
        td_criterion: "squares", as in the paper, or "cross_entropy" between target and value, which suits probabilities
            and needs critics with values in (0, 1).
        target_critics: the TD target takes the "min" of the critics, as in TD3, or their "mean", which is not biased
            low.
        policy_noise: standard deviation of the smoothing noise on the target policy, in [-1, 1] coordinates of the
            control.
        noise_clip: bound of the smoothing noise.
        hjb_noise: standard deviation of the noise on the action of the HJB residual, which biases V low.
        hjb_noise_clip: bound of that noise.
        hjb_time: the time, in s, in which an HJB residual is counted: the loss has the squares of hjb_time L^u Q. With
            one second, as in the paper, the weight of the residual depends on the unit of time; with the horizon it
            does not.
        hjb_delta: size beyond which an HJB residual times hjb_time counts linearly (Huber's loss), so that corners
            where V jumps faster than a network can follow do not outweigh all other points; None squares all residuals,
            as in the paper.
        hjb_probes: 0 computes the trace of the HJB residual exactly, by one column for each noise channel. A number of
            at least 2 estimates it with so many random vectors at each point, see `pirl_rl.operators`, which costs less
            where there are many channels. Squared residuals and their gradient keep their means; with `hjb_delta`
            the gradient has the right direction at each point on average.
        boundary_delta: the same for the error of V on the boundary, without unit.
        logit_penalty: factor of the mean square of the actor's outputs before their tanh, which is added to the actor's
            loss: a saturated tanh has no gradient that could correct a wrong action.
        td_weight, hjb_weight, boundary_weight: initial weights of the three terms.

    Raises:
        ArgumentError: an argument out of range, critics with which the actor rule cannot work, or a critic whose
            activation is not C^2.
    """

    td_weight: Tensor
    hjb_weight: Tensor
    boundary_weight: Tensor

    def __init__(
        self,
        problem: ReachAvoidProblem,
        actor: Actor,
        critics: Sequence[Critic],
        actor_rule: ActorRule,
        *,
        td_criterion: Literal["squares", "cross_entropy"] = "squares",
        target_critics: Literal["min", "mean"] = "min",
        policy_noise: float = 0.0,
        noise_clip: float = 0.5,
        hjb_noise: float = 0.0,
        hjb_noise_clip: float = 1.0,
        hjb_time: float = 1.0,
        hjb_delta: float | None = 1.0,
        hjb_probes: int = 0,
        boundary_delta: float | None = None,
        logit_penalty: float = 0.0,
        td_weight: float = 1.0,
        hjb_weight: float = 0.0,
        boundary_weight: float = 0.0,
    ):
        for critic in critics:
            actor_rule.check(critic)
        _check_choices(actor, actor_rule)
        td = TemporalDifferences(td_criterion, target_critics, policy_noise, noise_clip)
        if td_criterion == "cross_entropy" and not all(isinstance(critic.layers[-1], nn.Sigmoid) for critic in critics):
            raise ArgumentError("loss.td_criterion: 'cross_entropy' needs critics with output 'Sigmoid'")
        hjb = HJBResidual(problem, hjb_noise, hjb_noise_clip, hjb_time, hjb_delta, hjb_probes)
        for critic in critics:
            require_twice_differentiable(critic.layers)
        one = torch.ones(problem.controls.dim)
        modules = [
            TensorDictModule(critic, in_keys=["tau", "state", "action"], out_keys=["state_action_value"])
            for critic in critics
        ]
        own = torch.stack([TensorDict.from_module(module).data.clone() for module in modules])  # type: ignore[union-attr]
        super().__init__(
            TensorDictModule(actor, in_keys=["tau", "state"], out_keys=["action"]),
            # TorchRL would expand a list of one without parameters, and redraws a single module: hence the copy below.
            modules if len(modules) > 1 else modules[0],  # type: ignore[arg-type]
            bounds=(-one, one),  # type: ignore[arg-type]
            num_qvalue_nets=len(critics),
            policy_noise=policy_noise,
            noise_clip=noise_clip,
            loss_function="l2",
        )
        self.qvalue_network_params.data.copy_(own)
        self.target_qvalue_network_params.data.copy_(own)
        self.make_value_estimator(gamma=1.0)
        self.problem = problem
        self.td, self.hjb, self.boundary = td, hjb, BoundaryValues(boundary_delta)
        self.actor_rule = actor_rule
        self.logit_penalty = logit_penalty
        for name, value in zip(WEIGHTS, (td_weight, hjb_weight, boundary_weight), strict=True):
            self.register_coeff_buffer(name, float(value))
        self._bind()

    def _bind(self) -> None:
        """Make modules that share the parameters of this loss, which `TD3Loss` keeps outside of modules.

        To lend the parameters to a module for each call takes the compiler most of its time.
        """
        critics, actors = self.qvalue_network_params, self.actor_network_params
        targets = self.target_qvalue_network_params, self.target_actor_network_params
        # Lists are no modules, so that the state of the loss has each parameter once.
        self._critics = [_module(self.qvalue_network, params) for params in (critics, critics.data, targets[0])]
        self._actors = [_module(self.actor_network, params) for params in (actors, targets[1])]

    def __getstate__(self) -> dict[str, Any]:
        return {name: entry for name, entry in self.__dict__.items() if name not in ("_critics", "_actors")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._bind()

    @property
    def networks(self) -> Networks:
        """The networks and the weights of this loss."""
        critic, frozen, target_critic = self._critics
        actor, target_actor = self._actors
        weights = self.td_weight, self.hjb_weight, self.boundary_weight
        return Networks(critic, frozen, target_critic, actor, target_actor, weights)

    def with_noise(self, batch: TensorDictBase) -> TensorDictBase:
        """The batch with the random numbers of the critic loss as its part "noise".

        The losses draw them for batches without this part. Compiled code would draw other numbers than eager code, so
        that the learner adds them before.
        """
        # TD3Loss draws its smoothing noise before anything else; with the same order, both draw the same noise.
        noise = self.td.draw(batch["replay", "action"])
        if "collocation" in batch.keys():
            noise |= self.hjb.draw(batch["collocation", "state"])
        return batch.copy().set("noise", TensorDict(noise))

    def critic_loss(self, batch: TensorDictBase, networks: Networks | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted critic loss, Eq. (critic_loss), and its unweighted terms.

        Args:
            batch: see `PIRLLoss`; it may have the part "noise", see `with_noise`.
            networks: replace the networks and the weights of this loss.
        """
        networks = networks or self.networks
        batch = batch if "noise" in batch.keys() else self.with_noise(batch)
        noise, replay, parts = batch.get("noise"), batch.get("replay"), {}
        if "next" in replay.keys():
            parts["td_loss"] = self.td(networks, replay, noise)
        if "collocation" in batch.keys():
            parts["hjb_loss"] = self.hjb(networks, batch.get("collocation"), noise)
        if "boundary" in batch.keys():
            parts["boundary_loss"] = self.boundary(networks, batch.get("boundary"))
        weights = dict(zip(TERMS, networks.weights, strict=True))
        loss = sum((weights[name] * part for name, part in parts.items()), torch.zeros_like(networks.weights[0]))
        return loss, {name: part.detach() for name, part in parts.items()}

    def actor_loss(self, batch: TensorDictBase, networks: Networks | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """The negative objective of the actor rule, plus the logit penalty; no gradient reaches the critics.

        Arguments are those of `critic_loss`.
        """
        networks = networks or self.networks
        tau, x = batch["replay", "tau"], batch["replay", "state"]
        loss = torch.zeros((), device=tau.device)
        if self.logit_penalty:
            loss = loss + self.logit_penalty * networks.actor.logits(tau, x).square().mean()
        points = batch["collocation"] if "collocation" in batch.keys() else batch["replay"]
        solution = Solution(self.problem, networks.actor, networks.frozen_critic)
        return loss - self.actor_rule(solution, batch["replay"], points), {}

    def check_rule(self, rule: ActorRule, exploration_noise: float) -> None:
        """Refuse an actor rule that cannot work with these critics and this noise on played actions.

        Raises:
            ArgumentError: with what was expected and what was got.
        """
        rule.check(self.qvalue_network.module, exploration_noise)  # type: ignore[arg-type]
        _check_choices(self.actor_network.module, rule)  # type: ignore[arg-type]

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """`critic_loss`, under the name that `TD3Loss` has for it."""
        return self.critic_loss(tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        loss_actor, _ = self.actor_loss(tensordict)
        loss_qvalue, parts = self.critic_loss(tensordict)
        return TensorDict({"loss_actor": loss_actor, "loss_qvalue": loss_qvalue, **parts})

    def solution(self) -> Solution:
        """The solution on the parameters of this loss: it follows the training."""
        networks = self.networks
        return Solution(self.problem, networks.actor, networks.critic)


def _check_choices(actor: Actor, rule: ActorRule) -> None:
    if actor.choice and not rule.trains_choices:
        raise ArgumentError(
            f"actor_rule: expected BestControl with actor.choices={actor.choice.choices}, since the output of such an "
            f"actor has no gradient, got {type(rule).__name__}"
        )


def _module(network: TensorDictModule, params: TensorDictBase) -> Any:
    """A module with the structure of a network and with given parameters, stacked ones for critics."""
    twin = copy.deepcopy(network)
    params.to_module(twin, preserve_module_state=False)
    return twin.module
