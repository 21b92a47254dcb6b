"""Collectors: they play the current policy with exploration noise and fill the replay buffer.

- `SyncCollector`: one vectorised environment in the learner's process, in step with the updates. Exactly resumable.
- `MultiAsyncCollector`: Algorithm 1 of the paper: worker processes fill a shared buffer while the learner learns.
  Resumes statistically: the buffer comes back, the workers' episodes start anew.
"""

from __future__ import annotations

import copy
import logging
import os
import shutil
import signal
import time
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl import collectors as torchrl_collectors
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.weight_update import SharedMemWeightSyncScheme

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.networks import Actor

TRANSITION = ("tau", "state", "action", *(("next", key) for key in ("tau", "state", "reward", "terminated")))
"""What the loss reads of a transition."""

logging.getLogger("torchrl").setLevel(logging.WARNING)


class CollectorError(RuntimeError):
    """A worker died or delivered nothing; the message names it."""


class TransitionCollector(Protocol):
    """What the trainer asks of a collector; a state is loaded before `start`."""

    buffer: TensorDictReplayBuffer

    def start(self) -> None:
        """Fill the buffer to its warm-up."""

    def step(self, update: int) -> None:
        """Called before each update."""

    def close(self) -> None: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


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
            raise ValueError(f"collector: expected noise >= 0, always or at start; got {deviation!r} and {when!r}")
        self.deviation, self.when = deviation, when

    def forward(self, action: Tensor, is_init: Tensor) -> Tensor:
        noise = self.deviation * torch.randn_like(action)
        return (action + (noise if self.when == "always" else noise * is_init)).clamp(-1, 1)


def exploring_policy(actor: Actor, exploration: Exploration) -> TensorDictSequential:
    """The actor with noise."""
    return TensorDictSequential(
        TensorDictModule(actor, in_keys=["tau", "state"], out_keys=["action"]),  # type: ignore[arg-type]
        TensorDictModule(exploration, in_keys=["action", "is_init"], out_keys=["action"]),  # type: ignore[arg-type]
    )


class Transitions:
    """Turns a batch (envs, steps) into a flat list of transitions with n-step returns, gamma = 1.

    "next" is n steps ahead, or where the episode or the batch ends before; "reward" is the sum up to there.
    """

    def __init__(self, n_steps: int):
        if n_steps < 1:
            raise ValueError(f"collector.n_steps: expected at least 1, got {n_steps}")
        self.n_steps = n_steps

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        batch = batch.select(*TRANSITION)
        following, reward = batch["next"], batch["next", "reward"]
        total, ended = reward.clone(), following["terminated"]
        # TorchRL's MultiStep moves the next state but not its `terminated`, and would bootstrap from absorbed states.
        end = torch.arange(batch.shape[1], device=batch.device).expand(batch.shape).unsqueeze(-1)
        for _ in range(self.n_steps - 1):
            more = ~ended.gather(1, end) & (end < batch.shape[1] - 1)
            end = end + more
            total = total + reward.gather(1, end) * more
        batch["next"] = following.gather(1, end.squeeze(-1)).set("reward", total)
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
        exploration: when there is noise, "always" or at the "start" of episodes, see `Exploration`.
        n_steps: length of returns; use noise at the start only where it is above 1.
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
        exploration: Literal["always", "start"] = "always",
        n_steps: int = 1,
        seed: int = 0,
    ):
        _check_sizes(env, frames_per_batch, updates_per_batch, warmup_frames, buffer_size)
        self.env, self.updates_per_batch, self.warmup_frames = env, updates_per_batch, warmup_frames
        self.buffer, self._rng = _buffer(buffer_size, env.device, seed)
        self._collector = torchrl_collectors.Collector(
            env,
            exploring_policy(actor, Exploration(exploration_noise, exploration)),
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            init_random_frames=-(-warmup_frames // frames_per_batch) * frames_per_batch,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        self._batches = iter(self._collector)
        self._transitions = Transitions(n_steps)

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
            "buffer": _buffer_state(self.buffer, self._rng),
            "frames": self._collector.state_dict()["frames"],
            "carrier": self._collector._carrier.to_dict(),
            "env_rng": self.env.rng.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        _load_buffer(self.buffer, self._rng, state["buffer"])
        # TorchRL saves no environment state; the carried TensorDict is all that a ReachAvoidEnv has.
        self._collector.load_state_dict({**self._collector.state_dict(), "frames": state["frames"]})  # type: ignore[arg-type]
        self._collector._carrier.update(TensorDict(state["carrier"], device=self.env.device))
        self.env.rng.set_state(state["env_rng"])

    def _collect(self) -> None:
        self.buffer.extend(self._transitions(next(self._batches)))


class MultiAsyncCollector:
    """Worker processes fill a shared buffer while the learner learns; they play on the CPU.

    Args:
        env: its `recipe` is rebuilt in each worker, with seeds of its own.
        actor: copied to the workers every `updates_per_batch` updates.
        workers: processes.
        frames_per_batch: transitions a worker delivers at once, a multiple of the environment's batch size.
        updates_per_batch: updates between two copies.
        warmup_frames, buffer_size, exploration_noise, exploration, n_steps, seed: as for `SyncCollector`.
        patience: seconds without a transition until `CollectorError`; a dead worker is noticed at once.
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
        exploration: Literal["always", "start"] = "always",
        n_steps: int = 1,
        seed: int = 0,
        patience: float = 60.0,
    ):
        _check_sizes(env, frames_per_batch, updates_per_batch, warmup_frames, buffer_size)
        if workers < 1:
            raise ValueError(f"collector.workers: expected at least 1, got {workers}")
        self.updates_per_batch, self.warmup_frames, self.patience = updates_per_batch, warmup_frames, patience
        self.buffer, self._rng = _buffer(buffer_size, torch.device("cpu"), seed, shared=True)
        self._actor, self._copy, self._seed = actor, copy.deepcopy(actor).cpu(), seed
        recipes = [env.recipe(seed=seed + 1 + index) for index in range(workers)]
        self._envs = [partial(_worker_env, recipe, os.getpid()) for recipe in recipes]
        self._policy = exploring_policy(self._copy, Exploration(exploration_noise, exploration))
        self._frames_per_batch, self._transitions = frames_per_batch, Transitions(n_steps)
        self._collector: Any = None
        storage: Any = self.buffer.storage
        weakref.finalize(self, shutil.rmtree, storage.scratch_dir, ignore_errors=True)
        self._delivered, self._delivered_at = 0, 0.0

    def start(self) -> None:
        try:
            self._collector = torchrl_collectors.MultiAsyncCollector(
                self._envs,
                self._policy,
                frames_per_batch=self._frames_per_batch,
                total_frames=-1,
                init_random_frames=max(0, self.warmup_frames - self.buffer.write_count),
                replay_buffer=self.buffer,
                postproc=self._transitions,
                auto_register_policy_transforms=False,
                weight_sync_schemes={"policy": SharedMemWeightSyncScheme(sync=False)},  # type: ignore[call-arg]
            )
        except RuntimeError as error:
            raise CollectorError(f"rollout workers did not start, see their messages above: {error}") from None
        # Only now: a generator's state does not survive the way into a spawned process.
        self.buffer.set_rng(self._rng)
        self._collector.set_seed(self._seed)
        self._collector.start()
        self._delivered_at = time.monotonic()
        while self.buffer.write_count < self.warmup_frames:
            self._check_workers()
            time.sleep(0.02)

    def step(self, update: int) -> None:
        self._check_workers()
        if update % self.updates_per_batch == 0:
            self._copy.load_state_dict(self._actor.state_dict())
            self._collector.update_policy_weights_(self._policy)

    def close(self) -> None:
        if self._collector is not None:
            self._collector.async_shutdown()

    def state_dict(self) -> dict[str, Any]:
        return {"buffer": _buffer_state(self.buffer, self._rng)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        _load_buffer(self.buffer, self._rng, state["buffer"])

    def _check_workers(self) -> None:
        """TorchRL is silent about dead workers, and may wait for ever for their answer."""
        processes = self._collector.procs
        for index, process in enumerate(processes):
            if not process.is_alive():
                raise CollectorError(f"rollout worker {index} of {len(processes)} died, exit code {process.exitcode}")
        now, delivered = time.monotonic(), self.buffer.write_count
        if delivered != self._delivered:
            self._delivered, self._delivered_at = delivered, now
        elif now - self._delivered_at > self.patience:
            raise CollectorError(f"{len(processes)} rollout workers delivered nothing for {self.patience:.0f} s")


def _worker_env(recipe: Callable[[], ReachAvoidEnv], learner: int) -> ReachAvoidEnv:
    """An environment in its worker, which leaves Ctrl-C to the learner's process."""
    if os.getpid() != learner:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return recipe()


def _check_sizes(
    env: ReachAvoidEnv, frames_per_batch: int, updates_per_batch: int, warmup_frames: int, buffer_size: int
) -> None:
    envs = env.batch_size[0]
    if frames_per_batch % envs or frames_per_batch < envs:
        raise ValueError(
            f"collector.frames_per_batch: expected a multiple of env.num_envs = {envs}, got {frames_per_batch}"
        )
    if updates_per_batch < 1 or warmup_frames < 1:
        raise ValueError(
            f"collector: expected updates_per_batch and warmup_frames >= 1, got {updates_per_batch} and {warmup_frames}"
        )
    if buffer_size < frames_per_batch:
        raise ValueError(
            f"collector.buffer_size: expected at least frames_per_batch = {frames_per_batch}, got {buffer_size}"
        )


def _buffer(
    size: int, device: torch.device, seed: int, shared: bool = False
) -> tuple[TensorDictReplayBuffer, torch.Generator]:
    """A replay buffer and the generator of its sampling."""
    storage = LazyTensorStorage(size, device=device, shared_init=shared)
    buffer = TensorDictReplayBuffer(storage=storage, shared=shared)
    rng = torch.Generator(device).manual_seed(seed)
    if not shared:
        buffer.set_rng(rng)
    return buffer, rng


def _buffer_state(buffer: TensorDictReplayBuffer, rng: torch.Generator) -> dict[str, Any]:
    # Plain tensors: a memory-mapped one is a class of its own, which a checkpoint does not hold.
    plain = buffer[:].apply(lambda entry: entry.as_subclass(torch.Tensor)) if len(buffer) else TensorDict()
    return {
        "transitions": plain.to_dict(),
        "writer": buffer.writer.state_dict(),
        "rng": rng.get_state(),
    }


def _load_buffer(buffer: TensorDictReplayBuffer, rng: torch.Generator, state: dict[str, Any]) -> None:
    """Refill an empty buffer: unlike TorchRL's own, this keeps the storage on its device and in shared memory."""
    if state["transitions"]:
        transitions = TensorDict(state["transitions"]).auto_batch_size_(1)
        buffer.extend(transitions.to(rng.device))
    buffer.writer.load_state_dict(state["writer"])
    rng.set_state(state["rng"])
