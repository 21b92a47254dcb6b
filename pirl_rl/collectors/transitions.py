"""Exploration noise on actions, and n-step transitions from batches of steps."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Actor

TRANSITION = ("tau", "state", "action", "loc", *(("next", key) for key in ("tau", "state", "reward", "terminated")))
"""The entries of a transition that the loss reads; "loc" is the output of the actor, "action" the played action."""


class Exploration(nn.Module):
    """Adds clipped Gaussian noise to actions in [-1, 1].

    Args:
        deviation: standard deviation of the noise, >= 0.
        when: "always", or "start" for noise on the first step of an episode only. An n-step return then has noise in no
            action but the one whose value it estimates (exploring starts, Sutton and Barto, Reinforcement Learning,
            2nd ed., Sec. 5.3).

    Raises:
        ArgumentError: `deviation` is negative, or `when` is unknown.
    """

    def __init__(self, deviation: float, when: Literal["always", "start"]):
        super().__init__()
        if deviation < 0 or when not in ("always", "start"):
            raise ArgumentError(
                "collector: expected exploration_noise >= 0 and exploration 'always' or 'start', "
                f"got {deviation!r} and {when!r}"
            )
        self.deviation, self.when = deviation, when

    def forward(self, loc: Tensor, is_init: Tensor) -> Tensor:
        """The played action (N, m) for the actor's output `loc` (N, m) and `is_init` (N, 1) bool."""
        noise = self.deviation * torch.randn_like(loc)
        return (loc + (noise if self.when == "always" else noise * is_init)).clamp(-1, 1)


def exploring_policy(actor: Actor, exploration: Exploration) -> TensorDictSequential:
    """The actor followed by the noise, as a policy for collectors."""
    return TensorDictSequential(
        TensorDictModule(actor, in_keys=["tau", "state"], out_keys=["loc"]),  # type: ignore[arg-type]
        TensorDictModule(exploration, in_keys=["loc", "is_init"], out_keys=["action"]),  # type: ignore[arg-type]
    )


class Transitions:
    """Turns a batch (envs, steps) into transitions (envs * steps,) with n-step returns without discount.

    "next" is the state n steps later, or the last one of the episode or of the batch if that ends earlier. Its "reward"
    is the sum of the rewards until then.

    Args:
        n_steps: the length of returns, in control steps.

    Raises:
        ArgumentError: `n_steps` is below 1.
    """

    def __init__(self, n_steps: int):
        if n_steps < 1:
            raise ArgumentError(f"collector.n_steps: expected at least 1, got {n_steps}")
        self.n_steps = n_steps

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        if "loc" not in batch.keys():
            # The random actions of a warm-up come from no actor.
            batch = batch.set("loc", batch["action"])
        batch = batch.select(*TRANSITION)
        following: TensorDictBase = batch.get("next")
        reward, ended = following["reward"], following["terminated"]
        total = reward.clone()
        # TorchRL's MultiStep replaces the next state but not `terminated`, and would bootstrap from absorbed states.
        end = torch.arange(batch.shape[1], device=ended.device).expand(batch.shape).unsqueeze(-1)
        for _ in range(self.n_steps - 1):
            more = ~ended.gather(1, end) & (end < batch.shape[1] - 1)
            end = end + more
            total = total + reward.gather(1, end) * more
        batch["next"] = following.gather(1, end.squeeze(-1)).set("reward", total)
        return batch.reshape(-1)
