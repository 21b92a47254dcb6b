"""Playing: batches of steps of one environment, as transitions."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector

from pirl_rl.collectors.transitions import PlayedPolicy, Transitions
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.internals import carried, carry
from pirl_rl.recording import Recordings
from pirl_rl.sampling.initial_states import InitialStates


class Player:
    """Plays batches of steps of one environment with the current parameters of a policy.

    On a GPU the steps of a batch are recorded once as one graph of kernels, see `pirl_rl.recording`.

    Attributes:
        transitions: turns a batch of steps into transitions.

    Args:
        env: the environment.
        policy: the policy.
        frames_per_batch: steps of a batch, a multiple of the environment's batch size.
        random_frames: the first steps, which have uniformly random actions; rounded up to whole batches.
        n_steps: the length of returns, in control steps.

    Raises:
        ArgumentError: `n_steps` is below 1.
    """

    def __init__(
        self, env: ReachAvoidEnv, policy: PlayedPolicy, frames_per_batch: int, random_frames: int, n_steps: int
    ):
        self.env, self.policy = env, policy
        self.frames_per_batch, self.random_frames = frames_per_batch, random_frames
        self.transitions = Transitions(n_steps)
        self._state: dict[str, Any] = {"frames": 0, "carrier": {}}
        self._paths: TensorDictBase | None = None
        self._recordings = Recordings("playing", [env.rng])

    @cached_property
    def collector(self) -> Collector:
        """TorchRL's collector, which holds the paths that go on.

        It plays the policy once as it is made, which compiles it. A training that is refused for one of its settings
        need not wait for that.
        """
        collector = Collector(
            self.env,
            self.policy,
            frames_per_batch=self.frames_per_batch,
            total_frames=-1,
            init_random_frames=self._frames_of_random,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        self._resume(collector)
        return collector

    @cached_property
    def _batches(self) -> Iterator[TensorDictBase]:
        return iter(self.collector)

    def settle(self, initial_states: InitialStates, n_steps: int, exploration_noise: float) -> None:
        """Play with other settings from the next batch on, see `TransitionCollector.play`."""
        self.env.initial_states, self.transitions = initial_states, Transitions(n_steps)
        self.policy.exploration.deviation = exploration_noise
        self._recordings.forget()

    def play(self) -> TensorDictBase:
        """The transitions (frames_per_batch,) of the next batch."""
        if not self.env.stocked:
            return self.transitions(next(self._batches))
        paths = carried(self.collector)
        self.env.stock_up(self.frames_per_batch // self.env.batch_size[0], paths["state"])
        if self.collector.state_dict()["frames"] < self.collector.init_random_frames:
            return self.transitions(next(self._batches))
        if self._paths is None:
            self._paths = paths.clone()
        else:
            self._paths.update_(paths.select(*self._paths.keys()))
        return self._recordings("steps", self._go_on)

    def _go_on(self) -> TensorDictBase:
        """The transitions of the next batch, with paths that stay in the memory of `_paths`."""
        assert self._paths is not None
        carry(self.collector, self._paths.copy())
        # An iterator of the collector would close it after an error, as of a recording that fails.
        transitions = self.transitions(self.collector.rollout())
        self._paths.update_(carried(self.collector).select(*self._paths.keys()))
        carry(self.collector, self._paths.copy())
        return transitions

    def skip_random(self) -> None:
        """Play no random actions from the next batch on."""
        self.load_state_dict({"frames": self._frames_of_random, "carrier": {}})

    def state_dict(self) -> dict[str, Any]:
        """The number of steps played so far, and the paths that go on; without these, paths start anew."""
        if not self._plays:
            return self._state
        # TorchRL does not save the state of environments; that of a ReachAvoidEnv is the carried TensorDict.
        frames = self.collector.state_dict()["frames"]
        return {"frames": frames, "carrier": carried(self.collector).to_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state of `state_dict`."""
        self._state = state
        # TorchRL's collector draws random numbers as it is made, which must not come after the state of a generator.
        if self._plays or state["carrier"]:
            self._resume(self.collector)

    def close(self) -> None:
        """Stop playing."""
        if self._plays:
            self.collector.shutdown()

    @property
    def _plays(self) -> bool:
        """Whether TorchRL's collector is made."""
        return "collector" in vars(self)

    @property
    def _frames_of_random(self) -> int:
        return -(-self.random_frames // self.frames_per_batch) * self.frames_per_batch

    def _resume(self, collector: Collector) -> None:
        collector.load_state_dict({**collector.state_dict(), "frames": self._state["frames"]})  # type: ignore[arg-type]
        carried(collector).update(TensorDict(self._state["carrier"], device=self.env.device))
