"""Playing: batches of steps of one environment, as transitions."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

from tensordict import TensorDictBase
from torchrl.collectors import Collector

from pirl_rl.collectors.transitions import PlayedPolicy, Transitions
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.sampling.initial_states import InitialStates


class Player:
    """Plays batches of steps of one environment with the current parameters of a policy.

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

    @cached_property
    def collector(self) -> Collector:
        """TorchRL's collector, which holds the paths that go on.

        It plays the policy once as it is made, which compiles it. A training that is refused for one of its settings
        need not wait for that.
        """
        frames = self.frames_per_batch
        return Collector(
            self.env,
            self.policy,
            frames_per_batch=frames,
            total_frames=-1,
            init_random_frames=-(-self.random_frames // frames) * frames,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )

    @cached_property
    def _batches(self) -> Iterator[TensorDictBase]:
        return iter(self.collector)

    def settle(self, initial_states: InitialStates, n_steps: int, exploration_noise: float) -> None:
        """Play with other settings from the next batch on, see `TransitionCollector.play`."""
        self.env.initial_states, self.transitions = initial_states, Transitions(n_steps)
        self.policy.exploration.deviation = exploration_noise

    def play(self) -> TensorDictBase:
        """The transitions (frames_per_batch,) of the next batch."""
        return self.transitions(next(self._batches))

    def count(self, frames: int) -> None:
        """Set the number of steps played so far, which decides whether the next ones have random actions."""
        self.collector.load_state_dict({**self.collector.state_dict(), "frames": frames})  # type: ignore[arg-type]

    def close(self) -> None:
        """Stop playing."""
        if "collector" in vars(self):
            self.collector.shutdown()
