"""Collectors: they play the current policy with exploration noise and fill the replay buffer.

- `SyncCollector`: one vectorised environment in the learner's process, in step with the updates. Exactly resumable.
- `MultiAsyncCollector`: Algorithm 1 of the paper: worker processes fill a shared buffer while the learner learns.
  Resumes statistically: the buffer comes back, the workers' episodes start anew.
"""

from __future__ import annotations

import logging
from typing import Any, Protocol

from torchrl.data import TensorDictReplayBuffer

from pirl_rl.collectors.multi_async import MultiAsyncCollector
from pirl_rl.collectors.sync import SyncCollector
from pirl_rl.errors import CollectorError
from pirl_rl.sampling.initial_states import InitialStates

__all__ = ["CollectorError", "MultiAsyncCollector", "SyncCollector", "TransitionCollector"]

logging.getLogger("torchrl").setLevel(logging.WARNING)


class TransitionCollector(Protocol):
    """What the trainer asks of a collector. `load_state_dict` and `warm_start` come before `start`."""

    buffer: TensorDictReplayBuffer

    @property
    def initial_states(self) -> InitialStates:
        """The law of episodes' starts."""
        ...

    @property
    def n_steps(self) -> int:
        """Length of returns."""
        ...

    @property
    def exploration_noise(self) -> float:
        """Deviation of the noise on played actions."""
        ...

    def play(self, initial_states: InitialStates, n_steps: int, exploration_noise: float) -> None:
        """Continue with other starts, returns and noise, as a stage of a curriculum asks.

        Where the noise changes, the buffer is emptied: its actions are those of another policy.
        """

    def warm_start(self, buffer: dict[str, Any] | None) -> None:
        """Prepare a run whose actor is trained already: it plays the warm-up in place of random actions.

        Args:
            buffer: the "buffer" entry of another collector's state, whose transitions are taken over.
        """

    def start(self) -> None:
        """Fill the buffer to its warm-up."""

    def step(self, update: int) -> None:
        """Called before each update."""

    def close(self) -> None: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...
