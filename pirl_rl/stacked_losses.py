"""The losses of several members of a population with their gradients, in one program.

The networks and the batches of all members are stacked along a leading axis, over which `torch.func.vmap` maps the
losses of one member.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from pirl_rl.compilation import Compiled, rowwise
from pirl_rl.errors import ArgumentError
from pirl_rl.gradients import Gradient
from pirl_rl.losses import PIRLLoss
from pirl_rl.terms import Networks

PARAMS = (
    *("qvalue_network_params", "actor_network_params"),
    *("target_qvalue_network_params", "target_actor_network_params"),
)
"""The names of the parameters of a loss: of critics, actor and their targets."""

Trained = Literal["critic", "actor"]
"""The network whose loss is meant."""


Program = Callable[[Sequence[TensorDictBase], Sequence[Tensor], TensorDictBase], Gradient]
"""Maps stacked parameters, weights and batches to the losses (M,), their terms (M,) and their stacked gradients."""


class StackedLosses:
    """The losses of several members with the same networks and options, in one program.

    Args:
        compile: whether the program is compiled.
    """

    def __init__(self, compile: bool):
        self.compile = compile
        self._programs: dict[str, tuple[Any, Program]] = {}

    def __call__(self, which: Trained, losses: Sequence[PIRLLoss], batch: TensorDictBase) -> list[Gradient]:
        """The loss of the critics or of the actor of each member, with its terms and its gradient.

        Args:
            which: "critic" or "actor".
            losses: the loss of each of the M members.
            batch: the stacked batches of the members, (M,).

        Raises:
            ArgumentError: `torch.func.vmap` cannot map a function of the problem.
        """
        # The loss of one member, with the actor rule of its stage, is evaluated on the networks of all.
        key = losses[0], losses[0].actor_rule
        if which not in self._programs or self._programs[which][0] != key:
            self._programs[which] = key, self._program(which, losses[0])
        params: list[Any] = [TensorDict.stack([getattr(loss, name).data for loss in losses]) for name in PARAMS]
        for trained in params[:2]:
            trained.requires_grad_()
        weights = [torch.stack(entries) for entries in zip(*(loss.networks.weights for loss in losses), strict=True)]
        try:
            loss, terms, gradient = self._programs[which][1](params, weights, batch)
        except RuntimeError as error:
            if "vmap" not in str(error):
                raise
            raise ArgumentError(
                "trainer.seeds, or population of the outer loop: a function of the problem cannot be evaluated for "
                f"several members at once ({str(error).partition(chr(10))[0]}); train them one after another, with "
                "-m seed=0,1 or population=false"
            ) from error
        own = ({name: values[index] for name, values in terms.items()} for index in range(len(losses)))
        return list(zip(loss, own, zip(*gradient, strict=True), strict=True))  # type: ignore[arg-type]

    def _program(self, which: Trained, loss: PIRLLoss) -> Program:
        function, params = loss.critic_loss, loss.qvalue_network_params
        if which == "actor":
            loss.actor_rule.compile(self._mapped)
            function, params = loss.actor_loss, loss.actor_network_params
        keys = [tuple(name.split(".")) for name, _ in params.named_parameters()]
        # The networks of TorchRL's losses are modules without parameters, to which any can be lent.
        empty: list[Any] = [copy.deepcopy(loss.qvalue_network) for _ in range(3)]
        empty += [copy.deepcopy(loss.actor_network) for _ in range(2)]
        critic, frozen, target_critic, actor, target_actor = empty
        kept, position = {"preserve_module_state": False}, int(which == "actor")

        def of_member(params: Sequence[TensorDictBase], weights: Sequence[Tensor], batch: TensorDictBase):
            with (
                params[0].to_module(critic, **kept),
                params[0].detach().to_module(frozen, **kept),
                params[1].to_module(actor, **kept),
                params[2].to_module(target_critic, **kept),
                params[3].to_module(target_actor, **kept),
            ):
                critics = critic.module, frozen.module, target_critic.module
                return function(batch, Networks(*critics, actor.module, target_actor.module, weights))

        def program(params: Sequence[TensorDictBase], weights: Sequence[Tensor], batch: TensorDictBase) -> Gradient:
            trained = [params[position][key] for key in keys]
            found, terms = torch.func.vmap(of_member)(params, weights, batch)
            # A member's loss depends on its own parameters alone, so that the sum has the gradients of all.
            return found.detach(), terms, torch.autograd.grad(found.sum(), trained, allow_unused=True)

        whole = which == "critic" or loss.actor_rule.compiles_whole
        return Compiled(program, f"the loss of the {which}s", traced=True) if self.compile and whole else program

    def _mapped(self, inner: Callable[..., Tensor]) -> Callable[..., Tensor]:
        """An inner function of an actor rule, in a form that can be mapped over the members."""
        return rowwise(inner, "an inner function of the actor's loss") if self.compile else inner
