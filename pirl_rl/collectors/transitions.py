"""What is played and what is kept: exploration noise on actions, and n-step transitions out of batches."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Actor

TRANSITION = ("tau", "state", "action", "loc", *(("next", key) for key in ("tau", "state", "reward", "terminated")))
"""What the loss reads of a transition; "loc" is the actor's output, "action" what was played."""


class Exploration(nn.Module):
    """Adds clipped Gaussian noise to actions in [-1, 1].

    Args:
        deviation: of the noise.
        when: "always", or "start": on the first step of an episode only, so that n-step returns are those of the
            noise-free policy but for the action they are credited to (exploring starts, Sutton and Barto, Sec. 5.3).
    """

    def __init__(self, deviation: float, when: Literal["always", "start"]):
        super().__init__()
        if deviation < 0 or when not in ("always", "start"):
            raise ArgumentError(f"collector: expected noise >= 0, always or at start; got {deviation!r} and {when!r}")
        self.deviation, self.when = deviation, when

    def forward(self, loc: Tensor, is_init: Tensor) -> Tensor:
        noise = self.deviation * torch.randn_like(loc)
        return (loc + (noise if self.when == "always" else noise * is_init)).clamp(-1, 1)


def exploring_policy(actor: Actor, exploration: Exploration) -> TensorDictSequential:
    """The actor with noise."""
    return TensorDictSequential(
        TensorDictModule(actor, in_keys=["tau", "state"], out_keys=["loc"]),  # type: ignore[arg-type]
        TensorDictModule(exploration, in_keys=["loc", "is_init"], out_keys=["action"]),  # type: ignore[arg-type]
    )


class Transitions:
    """Turns a batch (envs, steps) into a flat list of transitions with n-step returns, gamma = 1.

    "next" is n steps ahead, or where the episode or the batch ends before; "reward" is the sum up to there.
    """

    def __init__(self, n_steps: int):
        if n_steps < 1:
            raise ArgumentError(f"collector.n_steps: expected at least 1, got {n_steps}")
        self.n_steps = n_steps

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        if "loc" not in batch.keys():
            # Random actions of a warm-up have no policy behind them.
            batch = batch.set("loc", batch["action"])
        batch = batch.select(*TRANSITION)
        following: TensorDictBase = batch.get("next")
        reward, ended = following["reward"], following["terminated"]
        total = reward.clone()
        # TorchRL's MultiStep moves the next state but not its `terminated`, and would bootstrap from absorbed states.
        end = torch.arange(batch.shape[1], device=ended.device).expand(batch.shape).unsqueeze(-1)
        for _ in range(self.n_steps - 1):
            more = ~ended.gather(1, end) & (end < batch.shape[1] - 1)
            end = end + more
            total = total + reward.gather(1, end) * more
        batch["next"] = following.gather(1, end.squeeze(-1)).set("reward", total)
        return batch.reshape(-1)
