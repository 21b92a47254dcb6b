"""Collectors: they play the current policy with exploration noise and fill the replay buffer.

- `SyncCollector`: one vectorised environment in the learner's process, in step with the updates. Exactly resumable.
- `MultiAsyncCollector`: Algorithm 1 of the paper: worker processes fill a shared buffer while the learner learns.
  Resumes statistically: the buffer comes back, the workers' episodes start anew.
"""

from __future__ import annotations

import logging
import time
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl import collectors as torchrl_collectors
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import AdditiveGaussianModule
from torchrl.weight_update import SharedMemWeightSyncScheme

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.networks import Actor

logging.getLogger("torchrl").setLevel(logging.WARNING)


class CollectorError(RuntimeError):
    """A worker died or delivered nothing; the message names it."""


class TransitionCollector(Protocol):
    """What the trainer asks of a collector."""

    buffer: TensorDictReplayBuffer

    def start(self) -> None:
        """Fill the buffer to its warm-up."""

    def step(self, update: int) -> None:
        """Called before each update."""

    def close(self) -> None: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


def exploring_policy(env: ReachAvoidEnv, actor: Actor, noise: float) -> TensorDictSequential:
    """The actor with Gaussian noise of the given deviation, in [-1, 1] coordinates, clipped to them."""
    act = TensorDictModule(actor, in_keys=["tau", "state"], out_keys=["action"])
    spec = env.action_spec_unbatched
    return TensorDictSequential(act, AdditiveGaussianModule(spec, sigma_init=noise, sigma_end=noise)).to(env.device)


def flatten(batch: TensorDictBase) -> TensorDictBase:
    """A batch (envs, steps) as one list of transitions; the buffer would else store slices of time."""
    return batch.reshape(-1)


class SyncCollector:
    """Collects `frames_per_batch` transitions every `updates_per_batch` updates.

    Args:
        env: played in place.
        actor: the learner's own, its parameters followed live.
        frames_per_batch: transitions a batch, a multiple of the environment's batch size.
        updates_per_batch: updates between two batches.
        warmup_frames: transitions of uniformly random actions before the first update.
        buffer_size: capacity of the replay buffer.
        exploration_noise: deviation of the noise on actions.
        seed: of the buffer's sampling.
    """

    def __init__(
        self,
        env: ReachAvoidEnv,
        actor: Actor,
        frames_per_batch: int = 256,
        updates_per_batch: int = 8,
        warmup_frames: int = 4_096,
        buffer_size: int = 50_000,
        exploration_noise: float = 0.2,
        seed: int = 0,
    ):
        envs = env.batch_size[0]
        if frames_per_batch % envs or frames_per_batch < envs:
            raise ValueError(
                f"collector.frames_per_batch: expected a multiple of env.num_envs = {envs}, got {frames_per_batch}"
            )
        _check_sizes(updates_per_batch, warmup_frames, buffer_size)
        self.env, self.updates_per_batch, self.warmup_frames = env, updates_per_batch, warmup_frames
        self.buffer = _buffer(buffer_size, env.device, seed)
        self._collector = torchrl_collectors.Collector(
            env,
            exploring_policy(env, actor, exploration_noise),
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            init_random_frames=warmup_frames,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        self._batches = iter(self._collector)

    def start(self) -> None:
        while len(self.buffer) < min(self.warmup_frames, self.buffer.storage.max_size):
            self._collect()

    def step(self, update: int) -> None:
        if update % self.updates_per_batch == 0:
            self._collect()

    def close(self) -> None:
        self._collector.shutdown()

    def state_dict(self) -> dict[str, Any]:
        return {
            "buffer": self.buffer.state_dict(),
            "frames": self._collector.state_dict()["frames"],
            "carrier": self._collector._carrier.to_dict(),
            "env_rng": self.env.rng.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.buffer.load_state_dict(state["buffer"])
        self._collector.load_state_dict({**self._collector.state_dict(), "frames": state["frames"]})
        # TorchRL saves no environment state; the carried TensorDict is all that a ReachAvoidEnv has.
        self._collector._carrier.update(state["carrier"])
        self.env.rng.set_state(state["env_rng"].cpu())

    def _collect(self) -> None:
        self.buffer.extend(flatten(next(self._batches)))


class MultiAsyncCollector:
    """Worker processes fill a shared buffer while the learner learns; on the CPU.

    Args:
        env: its `recipe` is rebuilt in each worker, with seeds of its own.
        actor: pushed to the workers every `updates_per_batch` updates.
        workers: processes.
        frames_per_batch: transitions a worker delivers at once, a multiple of the environment's batch size.
        updates_per_batch: updates between two pushes of the policy and checks of the workers.
        warmup_frames, buffer_size, exploration_noise, seed: as for `SyncCollector`.
        patience: seconds without a transition, or with a dead worker, until `CollectorError`.
    """

    def __init__(
        self,
        env: ReachAvoidEnv,
        actor: Actor,
        workers: int = 2,
        frames_per_batch: int = 256,
        updates_per_batch: int = 32,
        warmup_frames: int = 4_096,
        buffer_size: int = 50_000,
        exploration_noise: float = 0.2,
        seed: int = 0,
        patience: float = 60.0,
    ):
        _check_sizes(updates_per_batch, warmup_frames, buffer_size)
        if workers < 1:
            raise ValueError(f"collector.workers: expected at least 1, got {workers}")
        self.updates_per_batch, self.warmup_frames, self.patience = updates_per_batch, warmup_frames, patience
        self.buffer = _buffer(buffer_size, torch.device("cpu"), seed, shared=True)
        self._policy = exploring_policy(env, actor, exploration_noise)
        self._workers, self._checked = workers, 0.0
        self._collector = torchrl_collectors.MultiAsyncCollector(
            [env.recipe(seed=seed + 1_000 * (index + 1)) for index in range(workers)],
            self._policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            init_random_frames=warmup_frames,
            replay_buffer=self.buffer,
            postproc=flatten,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            weight_sync_schemes={"policy": SharedMemWeightSyncScheme(sync=False)},
        )
        self._collector.set_seed(seed)

    def start(self) -> None:
        self._collector.start()
        begin = time.monotonic()
        while self.buffer.write_count < self.warmup_frames:
            time.sleep(0.05)
            self._check_workers()
            if time.monotonic() - begin > self.patience:
                raise CollectorError(f"workers delivered no {self.warmup_frames} transitions in {self.patience:.0f} s")

    def step(self, update: int) -> None:
        # A push to a dead worker would wait for ever: look first.
        if time.monotonic() - self._checked > 1.0:
            self._check_workers()
        if update % self.updates_per_batch == 0:
            self._collector.update_policy_weights_(self._policy)

    def close(self) -> None:
        self._collector.async_shutdown()

    def state_dict(self) -> dict[str, Any]:
        return {"buffer": self.buffer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.buffer.load_state_dict(state["buffer"])

    def _check_workers(self) -> None:
        self._checked = time.monotonic()
        dead = [index for index, process in enumerate(self._collector.procs) if not process.is_alive()]
        if dead:
            codes = {index: self._collector.procs[index].exitcode for index in dead}
            raise CollectorError(f"rollout workers died: {codes} (worker: exit code) of {self._workers}")


def _check_sizes(updates_per_batch: int, warmup_frames: int, buffer_size: int) -> None:
    if updates_per_batch < 1 or warmup_frames < 1 or buffer_size < 1:
        raise ValueError(
            "collector: expected updates_per_batch, warmup_frames and buffer_size >= 1, "
            f"got {updates_per_batch}, {warmup_frames} and {buffer_size}"
        )


def _buffer(size: int, device: torch.device, seed: int, shared: bool = False) -> TensorDictReplayBuffer:
    storage = LazyTensorStorage(size, device=device, shared_init=shared)
    buffer = TensorDictReplayBuffer(storage=storage, shared=shared)
    buffer.set_rng(torch.Generator(device).manual_seed(seed))
    return buffer
