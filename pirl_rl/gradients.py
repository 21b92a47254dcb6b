"""The losses with their gradients, each compiled as one program, or evaluated eagerly where there is no compiler."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from torch import Tensor

from pirl_rl.compilation import compiled, is_compiler_failure, reason_of
from pirl_rl.losses import PIRLLoss

Terms = dict[str, Tensor]

LossFunction = Callable[[TensorDictBase], tuple[Tensor, Terms]]
"""Maps a batch to a loss, and to terms of it by name."""

Gradient = tuple[Tensor, Terms, tuple[Tensor | None, ...]]
"""A loss, its terms and its gradient in the parameters."""


class Gradients:
    """The loss of the critics and that of the actor, with their gradients.

    Attributes:
        compile: whether the losses are compiled; False after the compiler has failed.

    Args:
        loss: the losses and the networks.
        compile: whether the losses are compiled. Where that fails, as without a C++ compiler, they run eagerly after
            one warning.
    """

    def __init__(self, loss: PIRLLoss, compile: bool):
        self.loss, self.compile = loss, compile
        self._make_critic()
        self.make_actor()

    def critic(self, batch: TensorDictBase) -> Gradient:
        """The loss of the critics at a batch, see `PIRLLoss`, its terms and its gradient."""
        return self._evaluated(lambda: self._critic(batch))

    def actor(self, batch: TensorDictBase) -> Gradient:
        """The loss of the actor at a batch and its gradient; there are no terms."""
        return self._evaluated(lambda: self._actor(batch))

    def _make_critic(self) -> None:
        self._critic = self._compiler()(with_gradient(self.loss.critic_loss, self.loss.qvalue_network_params))

    def make_actor(self) -> None:
        """Make the loss of the actor anew, after its rule has changed."""
        compiler, rule = self._compiler(), self.loss.actor_rule
        rule.compile(compiler)
        differentiated = with_gradient(self.loss.actor_loss, self.loss.actor_network_params)
        self._actor = compiler(differentiated) if rule.compiles_whole else differentiated

    def _compiler(self) -> Callable[[Any], Any]:
        return compiled if self.compile else lambda function: function

    def _evaluated(self, evaluate: Callable[[], Gradient]) -> Gradient:
        """What a call of one of the losses returns. If compilation fails, both losses run eagerly from then on."""
        try:
            return evaluate()
        except Exception as error:
            if not self.compile or not is_compiler_failure(error):
                raise
            self.compile = False
            self._make_critic()
            self.make_actor()
            warnings.warn(f"updates run eagerly, about half as fast: {reason_of(error)}", stacklevel=4)
            return evaluate()


def with_gradient(function: LossFunction, params: TensorDictParams) -> Callable[[TensorDictBase], Gradient]:
    """The loss with its gradient in the parameters, so that compiled code computes both in one program."""
    parameters = tuple(params.parameters())

    def differentiated(batch: TensorDictBase) -> Gradient:
        loss, terms = function(batch)
        return loss.detach(), terms, torch.autograd.grad(loss, parameters, allow_unused=True)

    return differentiated
