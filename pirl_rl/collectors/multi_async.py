"""Collection in worker processes while the learner learns."""

from __future__ import annotations

import copy
import os
import shutil
import signal
import time
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import torch
from tensordict import TensorDict
from torch import nn
from torchrl import collectors as torchrl_collectors
from torchrl.weight_update import SharedMemWeightSyncScheme

from pirl_rl.collectors.buffers import buffer_state, check_sizes, fill_buffer, load_buffer, make_buffer
from pirl_rl.collectors.silence import Silence
from pirl_rl.collectors.transitions import ControlVariate, Exploration, PlayedPolicy, Transitions
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.errors import ArgumentError, CollectorError
from pirl_rl.internals import lock_writes_with, write_lock
from pirl_rl.networks import Actor
from pirl_rl.sampling.initial_states import InitialStates


class MultiAsyncCollector:
    """Worker processes on the CPU fill a shared buffer while the learner learns, as in Algorithm 1 of the paper.

    Args:
        env: the environment; each worker builds a copy with its own seed.
        actor: the learner's actor, copied to the workers every `updates_per_batch` updates.
        workers: the number of processes.
        frames_per_batch: transitions that a worker delivers at once, a multiple of the environment's batch size.
        updates_per_batch: updates between two copies of the actor.
        warmup_frames, buffer_size, exploration_noise, exploration, n_steps, control_variate, initial_states, seed:
            arguments of `SyncCollector`.
        patience: seconds without a new transition after which `CollectorError` is raised; for a worker that died it is
            raised at once.

    Raises:
        ArgumentError: a number is out of range, or `exploration` is unknown.
    """

    def __init__(
        self,
        env: ReachAvoidEnv,
        actor: Actor,
        workers: int = 2,
        frames_per_batch: int = 5_120,
        updates_per_batch: int = 32,
        warmup_frames: int = 4_096,
        buffer_size: int = 50_000,
        exploration_noise: float = 0.0,
        exploration: Literal["always", "start"] = "always",
        n_steps: int = 20,
        control_variate: ControlVariate | None = None,
        initial_states: InitialStates | None = None,
        seed: int = 0,
        patience: float = 60.0,
    ):
        check_sizes(env, frames_per_batch, updates_per_batch, warmup_frames, buffer_size)
        if workers < 1:
            raise ArgumentError(f"collector.workers: expected at least 1, got {workers}")
        self.updates_per_batch, self.warmup_frames, self.patience = updates_per_batch, warmup_frames, patience
        self.buffer, self._rng = make_buffer(buffer_size, torch.device("cpu"), seed, shared=True)
        self._networks = nn.ModuleList([actor] if control_variate is None else [actor, control_variate])
        self._seed, self._exploration = seed, Exploration(exploration_noise, exploration)
        self._env, self._workers, self._random_warmup = env, workers, True
        env.initial_states = initial_states or env.initial_states
        self._frames_per_batch, self._transitions = frames_per_batch, Transitions(n_steps)
        self._collector: Any = None
        self._weights: Any = None
        self._write_lock = write_lock(self.buffer)
        storage: Any = self.buffer.storage
        weakref.finalize(self, shutil.rmtree, storage.scratch_dir, ignore_errors=True)
        self._delivered, self._silence = 0, Silence()

    @property
    def initial_states(self) -> InitialStates:
        return self._env.initial_states

    @property
    def n_steps(self) -> int:
        return self._transitions.n_steps

    @property
    def exploration_noise(self) -> float:
        return self._exploration.deviation

    def play(self, initial_states: InitialStates, n_steps: int, exploration_noise: float) -> None:
        """See `TransitionCollector.play`; the workers are started again if something changes."""
        other_noise = exploration_noise != self.exploration_noise
        if initial_states is self.initial_states and n_steps == self.n_steps and not other_noise:
            return
        self.close()
        self._env.initial_states, self._transitions = initial_states, Transitions(n_steps)
        if other_noise:
            self._exploration.deviation = exploration_noise
            self.buffer.empty(empty_write_count=False)
        if self._collector is not None:
            self.start()

    def warm_start(self, buffer: dict[str, Any] | None) -> None:
        self._random_warmup = False
        if buffer is not None:
            fill_buffer(self.buffer, self._rng.device, self._env, buffer)

    def start(self) -> None:
        # The seeds depend on the count of transitions, so that a later start does not repeat the noise of the first.
        seeds = range(first := self._seed + 1 + self.buffer.write_count, first + self._workers)
        recipes = [self._env.recipe(seed) for seed in seeds]
        self._copy = copy.deepcopy(self._networks).cpu()
        actor, *control_variate = self._copy
        self._policy = PlayedPolicy(actor, self._exploration, *control_variate)  # type: ignore[arg-type]
        # The state of the random generator does not survive being sent to a spawned process, and only the learner's
        # process watches the workers.
        self.buffer.set_rng(None)
        lock_writes_with(self.buffer, self._write_lock)
        self._weights = SharedMemWeightSyncScheme(sync=False)  # type: ignore[call-arg]
        try:
            self._collector = torchrl_collectors.MultiAsyncCollector(
                [partial(_worker_env, recipe, os.getpid()) for recipe in recipes],
                self._policy,
                frames_per_batch=self._frames_per_batch,
                total_frames=-1,
                init_random_frames=max(0, self.warmup_frames - self.buffer.write_count) * self._random_warmup,
                replay_buffer=self.buffer,
                postproc=self._transitions,
                auto_register_policy_transforms=False,
                weight_sync_schemes={"policy": self._weights},
            )
        except RuntimeError as error:
            raise CollectorError(
                f"the {self._workers} rollout workers did not start; their messages above say why: {error}"
            ) from None
        self.buffer.set_rng(self._rng)
        lock_writes_with(self.buffer, _WatchedLock(self._write_lock, self._check_workers))
        self._collector.set_seed(first)
        self._collector.start()
        self._silence = Silence()
        while len(self.buffer) < min(self.warmup_frames, self.buffer.storage.max_size):
            self._check_workers()
            time.sleep(0.02)

    def step(self, update: int) -> None:
        self._check_workers()
        if update % self.updates_per_batch == 0:
            self._copy.load_state_dict(self._networks.state_dict())
            self._collector.update_policy_weights_(self._policy)

    def close(self) -> None:
        if self._collector is not None:
            self._collector.async_shutdown()
            # Otherwise its destructor starts a thread, which hangs if the interpreter is about to end.
            self._weights.shutdown()

    def state_dict(self) -> dict[str, Any]:
        # Workers go on writing while a checkpoint is written, and its checksums would be those of other numbers.
        with write_lock(self.buffer):
            buffer = buffer_state(self.buffer, self._rng)
            buffer["transitions"] = TensorDict(buffer["transitions"]).clone().to_dict()
        return {"buffer": buffer, "exploration_noise": self.exploration_noise}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        load_buffer(self.buffer, self._rng, state["buffer"])
        self._exploration.deviation = state["exploration_noise"]

    def _check_workers(self) -> None:
        """TorchRL does not report workers that died, and may wait for them forever.

        Raises:
            CollectorError: a worker died, or there was no new transition for `patience` seconds.
        """
        processes = self._collector.procs
        for index, process in enumerate(processes):
            if not process.is_alive():
                raise CollectorError(f"rollout worker {index} of {len(processes)} died, exit code {process.exitcode}")
        before, self._delivered = self._delivered, self.buffer.write_count
        if self._silence.after(self._delivered != before) > self.patience:
            raise CollectorError(f"{len(processes)} rollout workers delivered nothing for {self.patience:.0f} s")


class _WatchedLock:
    """A lock that checks the workers while it waits, because a worker may die while it holds the lock.

    Args:
        lock: the lock of the shared buffer.
        check: called after every second of waiting; raises if a worker died.
    """

    def __init__(self, lock: Any, check: Callable[[], None]):
        self._lock, self._check = lock, check

    def __enter__(self) -> None:
        while not self._lock.acquire(timeout=1.0):
            self._check()

    def __exit__(self, *error: object) -> None:
        self._lock.release()


def _worker_env(recipe: Callable[[], ReachAvoidEnv], learner: int) -> ReachAvoidEnv:
    """Build the environment in a worker, where SIGINT is ignored, since the learner's process handles it."""
    if os.getpid() != learner:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return recipe()
