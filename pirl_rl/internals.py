"""Private names of torch and TorchRL that this package relies on, in one place: a new version is checked against it."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch._dynamo.exc import BackendCompilerFailed
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import TD3Loss

from pirl_rl.schedules import WEIGHTS

__all__ = [
    "BackendCompilerFailed",
    "ScheduledTD3Loss",
    "carried",
    "lock_writes_with",
    "plays_at_random",
    "write_lock",
]


class ScheduledTD3Loss(TD3Loss):
    """TD3's loss with buffers for the weights of the critic loss: an assignment moves a weight in place."""

    _schedulable_buffers = frozenset(WEIGHTS)


def carried(collector: Collector) -> TensorDictBase:
    """The TensorDict that a collector carries from one step to the next, with the state of all environments."""
    return collector._carrier


def plays_at_random(collector: Collector) -> bool:
    """Whether the next batch of a collector still belongs to its random warm-up."""
    return collector._should_use_random_frames()


def write_lock(buffer: TensorDictReplayBuffer) -> Any:
    """The lock between processes under which a shared buffer is written and sampled."""
    return buffer._write_lock


def lock_writes_with(buffer: TensorDictReplayBuffer, lock: Any) -> None:
    """Let another lock, or a wrapper of its own, take the place of a shared buffer's."""
    buffer._write_lock = lock
