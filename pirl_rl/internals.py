"""The private names of TorchRL on which this package relies; check them when a version changes."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate, TD3Loss

from pirl_rl.schedules import WEIGHTS

__all__ = [
    "FusedSoftUpdate",
    "ScheduledTD3Loss",
    "carried",
    "carry",
    "generator_of",
    "lock_writes_with",
    "write_lock",
]


class ScheduledTD3Loss(TD3Loss):
    """TD3's loss with the weights of the critic loss as buffers, which an assignment changes in place."""

    _schedulable_buffers = frozenset(WEIGHTS)


class FusedSoftUpdate(SoftUpdate):
    """TorchRL's updater of target networks for one of the networks, with one fused operation for all its tensors.

    `SoftUpdate.step` takes 20 times as long for networks of this size, most of it to look up the tensors one by one.

    Args:
        loss: holds the networks and their targets. Its tensors are changed in place and must stay the same objects.
        network: "actor_network" or "qvalue_network".
        tau: the rate, in (0, 1], at which the target follows.
    """

    def __init__(self, loss: TD3Loss, network: str, tau: float):
        super().__init__(loss, tau=tau)
        source: Any = self._sources[f"{network}_params"].data
        target = self._targets[f"target_{network}_params"].data
        self._followed = list(source.values(True, True))
        self._followers = [target[key] for key in source.keys(True, True)]

    def step(self) -> None:
        """Move the target by the share 1 - `eps`, which may be a tensor."""
        if isinstance(self.eps, float):
            get_ema_multi_avg_fn(self.eps)(self._followers, self._followed, None)
            return
        moves = torch._foreach_sub(self._followed, self._followers)
        torch._foreach_mul_(moves, 1 - self.eps)
        torch._foreach_add_(self._followers, moves)


def carried(collector: Collector) -> TensorDictBase:
    """The TensorDict that a collector keeps between steps, with the states of all environments."""
    return collector._carrier


def carry(collector: Collector, tensordict: TensorDictBase) -> None:
    """Replace the TensorDict that a collector keeps between steps."""
    collector._carrier = tensordict


def generator_of(buffer: TensorDictReplayBuffer) -> torch.Generator | None:
    """The random generator with which a buffer is sampled."""
    return buffer._rng


def write_lock(buffer: TensorDictReplayBuffer) -> Any:
    """The lock between processes that is held while a shared buffer is written or sampled."""
    return buffer._write_lock


def lock_writes_with(buffer: TensorDictReplayBuffer, lock: Any) -> None:
    """Replace the lock of a shared buffer."""
    buffer._write_lock = lock
