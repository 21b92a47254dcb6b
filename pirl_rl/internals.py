"""The private names of TorchRL on which this package relies; check them when a version changes."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import TD3Loss

from pirl_rl.schedules import WEIGHTS

__all__ = [
    "ScheduledTD3Loss",
    "carried",
    "lock_writes_with",
    "write_lock",
]


class ScheduledTD3Loss(TD3Loss):
    """TD3's loss with the weights of the critic loss as buffers, which an assignment changes in place."""

    _schedulable_buffers = frozenset(WEIGHTS)


def carried(collector: Collector) -> TensorDictBase:
    """The TensorDict that a collector keeps between steps, with the states of all environments."""
    return collector._carrier


def write_lock(buffer: TensorDictReplayBuffer) -> Any:
    """The lock between processes that is held while a shared buffer is written or sampled."""
    return buffer._write_lock


def lock_writes_with(buffer: TensorDictReplayBuffer, lock: Any) -> None:
    """Replace the lock of a shared buffer."""
    buffer._write_lock = lock
