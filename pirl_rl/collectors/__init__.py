"""Collectors: they play the current policy with exploration noise and fill the replay buffer.

- `SyncCollector`: one vectorised environment in the learner's process, in step with the updates. A resumed run equals
  an uninterrupted one.
- `MultiAsyncCollector`: worker processes fill a shared buffer while the learner learns, as in Algorithm 1 of the paper.
  A resumed run equals an uninterrupted one in distribution only: the buffer is restored, but the workers start new
  episodes.
- `RayCollector`: the same with worker processes on the machines of a Ray cluster. A worker that dies is replaced.
"""

from __future__ import annotations

import logging
from typing import Any, Protocol

from torchrl.data import TensorDictReplayBuffer

from pirl_rl.collectors.multi_async import MultiAsyncCollector
from pirl_rl.collectors.ray import RayCollector
from pirl_rl.collectors.sync import SyncCollector
from pirl_rl.collectors.transitions import ControlVariate
from pirl_rl.errors import CollectorError
from pirl_rl.sampling.initial_states import InitialStates

__all__ = [
    "CollectorError",
    "ControlVariate",
    "MultiAsyncCollector",
    "RayCollector",
    "SyncCollector",
    "TransitionCollector",
]

logging.getLogger("torchrl").setLevel(logging.WARNING)


class TransitionCollector(Protocol):
    """The interface of a collector. `load_state_dict` and `warm_start` are called before `start`.

    Attributes:
        buffer: the replay buffer; its entries are those of `pirl_rl.collectors.transitions.TRANSITION`.
    """

    buffer: TensorDictReplayBuffer

    @property
    def initial_states(self) -> InitialStates:
        """The distribution of the initial states of episodes."""
        ...

    @property
    def n_steps(self) -> int:
        """The length of returns, in control steps."""
        ...

    @property
    def exploration_noise(self) -> float:
        """The standard deviation of the noise on played actions, which are normalised to [-1, 1]."""
        ...

    def play(self, initial_states: InitialStates, n_steps: int, exploration_noise: float) -> None:
        """Continue with the settings of a stage of a curriculum.

        If the noise changes, the buffer is emptied, because its actions come from another policy.

        Args:
            initial_states: the distribution of the initial states of episodes.
            n_steps: the length of returns, in control steps.
            exploration_noise: standard deviation of the noise on played actions.
        """

    def warm_start(self, buffer: dict[str, Any] | None) -> None:
        """Prepare a run with a trained actor, which plays the warm-up in place of random actions.

        Args:
            buffer: the entry "buffer" of another collector's state, whose transitions are copied; None for none.

        Raises:
            ArgumentError: the transitions do not fit the environment.
        """

    def start(self) -> None:
        """Fill the buffer with the transitions of the warm-up."""

    def step(self, update: int) -> None:
        """Collect what is due before an update, counted from 0."""

    def close(self) -> None:
        """Stop playing and free the resources."""

    def state_dict(self) -> dict[str, Any]:
        """The state for a checkpoint, as tensors and plain values."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from a checkpoint."""
