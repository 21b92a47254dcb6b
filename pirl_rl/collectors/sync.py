"""Collection in the learner's process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from tensordict import TensorDictBase

from pirl_rl.checkpoint import restore_rng
from pirl_rl.collectors.buffers import buffer_state, check_sizes, fill_buffer, load_buffer, make_buffer
from pirl_rl.collectors.player import Player
from pirl_rl.collectors.transitions import ControlVariate, Exploration, PlayedPolicy
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.networks import Actor
from pirl_rl.sampling.initial_states import InitialStates


class SyncCollector:
    """Collects `frames_per_batch` transitions every `updates_per_batch` updates, in the learner's process.

    Attributes:
        source: plays a batch and returns its transitions (frames_per_batch,).

    Args:
        env: the environment.
        actor: the learner's actor; its current parameters are used.
        frames_per_batch: transitions of a batch, a multiple of the environment's batch size.
        updates_per_batch: updates between two batches.
        warmup_frames: transitions before the first update, with uniformly random actions, or after `warm_start` with
            those of the actor.
        buffer_size: capacity of the replay buffer, in transitions.
        exploration_noise: standard deviation of the noise on actions, which are normalised to [-1, 1].
        exploration: "always" for noise on every action, "start" for the first of each episode, see `Exploration`.
        n_steps: the length of returns, in control steps; with `exploration="start"` it should be above 1.
        control_variate: takes the noise of the physics out of the returns, see `pirl_rl.collectors.transitions`; None
            leaves it in.
        initial_states: the distribution of the initial states of episodes, in place of that of the environment.
        seed: the seed of sampling from the buffer.

    Raises:
        ArgumentError: a number is out of range, or `exploration` is unknown.
    """

    def __init__(
        self,
        env: ReachAvoidEnv,
        actor: Actor,
        frames_per_batch: int = 5_120,
        updates_per_batch: int = 80,
        warmup_frames: int = 4_096,
        buffer_size: int = 50_000,
        exploration_noise: float = 0.0,
        exploration: Literal["always", "start"] = "always",
        n_steps: int = 20,
        control_variate: ControlVariate | None = None,
        initial_states: InitialStates | None = None,
        seed: int = 0,
    ):
        check_sizes(env, frames_per_batch, updates_per_batch, warmup_frames, buffer_size)
        self.env, self.updates_per_batch, self.warmup_frames = env, updates_per_batch, warmup_frames
        env.initial_states = initial_states or env.initial_states
        self.buffer, self._rng = make_buffer(buffer_size, env.device, seed)
        policy = PlayedPolicy(actor, Exploration(exploration_noise, exploration), control_variate)
        self._player = Player(env, policy, frames_per_batch, warmup_frames, n_steps)
        self.source: Callable[[], TensorDictBase] = self._player.play

    @property
    def policy(self) -> PlayedPolicy:
        return self._player.policy

    @property
    def has_played(self) -> bool:
        """Whether no random actions are to come, since there are steps already or the actor plays from the start."""
        return self._player.state_dict()["frames"] > 0

    @property
    def frames_per_batch(self) -> int:
        return self._player.frames_per_batch

    @property
    def initial_states(self) -> InitialStates:
        return self.env.initial_states

    @property
    def n_steps(self) -> int:
        return self._player.transitions.n_steps

    @property
    def exploration_noise(self) -> float:
        return self._player.policy.exploration.deviation

    def play(self, initial_states: InitialStates, n_steps: int, exploration_noise: float) -> None:
        other_noise = exploration_noise != self.exploration_noise
        self._player.settle(initial_states, n_steps, exploration_noise)
        if other_noise:
            self.buffer.empty()

    def warm_start(self, buffer: dict[str, Any] | None) -> None:
        if buffer is not None:
            fill_buffer(self.buffer, self._rng.device, self.env, buffer)
        self._player.skip_random()

    def start(self) -> None:
        while len(self.buffer) < min(self.warmup_frames, self.buffer.storage.max_size):
            self._collect()

    def step(self, update: int) -> None:
        if update % self.updates_per_batch == 0:
            self._collect()
        self.start()  # a stage may have emptied the buffer

    def close(self) -> None:
        self._player.close()

    def state_dict(self) -> dict[str, Any]:
        return {
            "buffer": buffer_state(self.buffer, self._rng),
            "exploration_noise": self.exploration_noise,
            **self._player.state_dict(),
            "env_rng": self.env.rng.get_state(),
            "supply": self.env.supply.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        load_buffer(self.buffer, self._rng, state["buffer"])
        self._player.policy.exploration.deviation = state["exploration_noise"]
        self._player.load_state_dict({name: state[name] for name in ("frames", "carrier")})
        restore_rng(self.env.rng, state["env_rng"])
        self.env.supply.load_state_dict(state["supply"])

    def _collect(self) -> None:
        self.buffer.extend(self.source())
