"""Collection by worker processes on the machines of a Ray cluster, while the learner learns."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.cluster import check_address, connected, reason_of, require_ray
from pirl_rl.collectors.buffers import buffer_state, check_sizes, fill_buffer, load_buffer, make_buffer
from pirl_rl.collectors.player import Player
from pirl_rl.collectors.silence import Silence
from pirl_rl.collectors.transitions import ControlVariate, Exploration, PlayedPolicy, Transitions
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.errors import ArgumentError, CollectorError
from pirl_rl.networks import Actor
from pirl_rl.progress import announce
from pirl_rl.sampling.initial_states import InitialStates

MOST_DEATHS = 3
"""How many deaths in a row, for each worker, end the collection if no batch arrives in between."""

POLL = 0.02
"""Seconds between two looks at the workers while the learner waits for the warm-up."""


class RayCollector:
    """Worker processes on a Ray cluster play while the learner learns; the buffer stays in the learner's process.

    Each worker plays one batch at a time, with the networks that were the newest when it began. The learner does not
    run ahead of slow workers: every `updates_per_batch` updates it sends its networks, and waits, if it must, until a
    batch has come that was played with those of the time before, or with newer ones.

    A worker that dies, or whose machine is lost, is replaced by a new one with other random numbers, and only its
    current batch is lost. (Ray could restart it by itself, but would repeat the random numbers of the first one.)

    Args:
        env: the environment; each worker builds a copy with its own seed on the CPU.
        actor: the learner's actor.
        workers: the number of processes, each of which takes one processor of the cluster.
        address: the address of a running cluster, such as "10.0.0.1:6379", or "auto" for that to which this machine
            belongs; None starts a Ray of its own on this machine.
        frames_per_batch: transitions that a worker delivers at once, a multiple of the environment's batch size.
        updates_per_batch: updates between two times that the networks are sent, see above.
        warmup_frames, buffer_size, exploration_noise, exploration, n_steps, control_variate, initial_states, seed:
            arguments of `SyncCollector`.
        patience: seconds of silence, without a batch and without a death, after which `CollectorError` is raised.

    Raises:
        ArgumentError: a number is out of range, or `exploration` is unknown.
        ClusterError: Ray is not installed.
    """

    def __init__(
        self,
        env: ReachAvoidEnv,
        actor: Actor,
        workers: int = 2,
        address: str | None = None,
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
        patience: float = 120.0,
    ):
        check_sizes(env, frames_per_batch, updates_per_batch, warmup_frames, buffer_size)
        if workers < 1:
            raise ArgumentError(f"collector.workers: expected at least 1, got {workers}")
        if not patience > 0:
            raise ArgumentError(f"collector.patience: expected a number of seconds > 0, got {patience}")
        check_address(address)
        require_ray("collector")
        self.updates_per_batch, self.warmup_frames, self.patience = updates_per_batch, warmup_frames, patience
        self.buffer, self._rng = make_buffer(buffer_size, env.device, seed)
        self._env, self._workers, self._address, self._seed = env, workers, address, seed
        env.initial_states = initial_states or env.initial_states
        self._policy = PlayedPolicy(actor, Exploration(exploration_noise, exploration), control_variate)
        self._frames_per_batch, self._n_steps = frames_per_batch, Transitions(n_steps).n_steps
        self._random_warmup = True
        self._held = ExitStack()
        self._ray: Any = None
        self._processes: list[Any] = []
        # The batches that are being played, with the index of the worker and the number of its networks.
        self._playing: dict[Any, tuple[int, int]] = {}
        self._weights: Any = None
        self._sent, self._newest = 0, 0  # the numbers of the networks that were sent last, and played last
        self._deaths, self._silence = 0, Silence()

    @property
    def initial_states(self) -> InitialStates:
        return self._env.initial_states

    @property
    def n_steps(self) -> int:
        return self._n_steps

    @property
    def exploration_noise(self) -> float:
        return self._policy.exploration.deviation

    def play(self, initial_states: InitialStates, n_steps: int, exploration_noise: float) -> None:
        """See `TransitionCollector.play`; what the workers play at that time is thrown away if something changes."""
        other_noise = exploration_noise != self.exploration_noise
        if initial_states is self.initial_states and n_steps == self.n_steps and not other_noise:
            return
        self._env.initial_states, self._n_steps = initial_states, n_steps
        if other_noise:
            self._policy.exploration.deviation = exploration_noise
            self.buffer.empty(empty_write_count=False)
        self._playing.clear()
        for index, process in enumerate(self._processes):
            process.settle.remote(initial_states, n_steps, exploration_noise)
            self._send(index)

    def warm_start(self, buffer: dict[str, Any] | None) -> None:
        self._random_warmup = False
        if buffer is not None:
            fill_buffer(self.buffer, self._rng.device, self._env, buffer)

    def start(self) -> None:
        self._ray = self._held.enter_context(connected(self._address, self._workers))
        self._publish()
        self._silence = Silence()
        self._processes = [self._new_process(index) for index in range(self._workers)]
        for index in range(self._workers):
            self._send(index)
        self._fill()

    def step(self, update: int) -> None:
        if update % self.updates_per_batch == 0:
            self._publish()
        self._receive()
        while self._newest < self._sent - 1:
            time.sleep(POLL)
            self._receive()
        self._fill()  # a stage may have emptied the buffer

    def close(self) -> None:
        for process in self._processes:
            self._ray.kill(process)
        self._processes, self._weights = [], None
        self._playing.clear()
        self._held.close()

    def state_dict(self) -> dict[str, Any]:
        return {"buffer": buffer_state(self.buffer, self._rng), "exploration_noise": self.exploration_noise}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        load_buffer(self.buffer, self._rng, state["buffer"])
        self._policy.exploration.deviation = state["exploration_noise"]

    def _publish(self) -> None:
        """Put the newest networks where the workers find them."""
        weights = {name: entry.detach().cpu() for name, entry in self._policy.state_dict().items()}
        self._weights = self._ray.put(weights)
        self._sent += 1

    def _new_process(self, index: int) -> Any:
        # The seeds depend on the count of transitions, so that no process repeats the noise of one before it.
        words = np.random.SeedSequence([self._seed, self.buffer.write_count, self._deaths, index]).generate_state(2)
        physics, policy = (int(word) for word in words)
        missing = max(0, self.warmup_frames - self.buffer.write_count) * self._random_warmup
        batches = -(-missing // self._frames_per_batch)  # the first workers play those that cannot be shared evenly
        return (
            self._ray.remote(Worker)
            .options(num_cpus=1)
            .remote(
                self._env.recipe(physics),
                copy.deepcopy(self._policy).cpu(),
                self._frames_per_batch,
                (batches + self._workers - 1 - index) // self._workers * self._frames_per_batch,
                self._n_steps,
                policy,
            )
        )

    def _send(self, index: int) -> None:
        self._playing[self._processes[index].play.remote(self._weights)] = index, self._sent

    def _fill(self) -> None:
        while len(self.buffer) < min(self.warmup_frames, self.buffer.storage.max_size):
            time.sleep(POLL)
            self._receive()

    def _receive(self) -> None:
        """Move what the workers have played into the buffer, let them go on, and replace those that died.

        Raises:
            CollectorError: the problem raised an error in a worker, workers keep dying, or nothing was heard of any
                worker for `patience` seconds.
        """
        done, _ = self._ray.wait(list(self._playing), num_returns=self._workers, timeout=0)
        for batch in done:
            index, networks = self._playing.pop(batch)
            try:
                transitions: TensorDictBase = self._ray.get(batch)
            except self._ray.exceptions.RayTaskError as error:
                raise CollectorError(f"{self._name(index)} failed: {reason_of(error)}") from None
            except self._ray.exceptions.RayError as error:
                self._replace(index, reason_of(error))
            else:
                self.buffer.extend(transitions.to(self._rng.device))
                self._deaths, self._newest = 0, max(self._newest, networks)
            self._send(index)
        if self._silence.after(bool(done)) > self.patience:
            free = self._ray.available_resources().get("CPU", 0)
            raise CollectorError(
                f"{self._workers} rollout workers delivered nothing for {self.patience:.0f} s; each needs a processor "
                f"of the Ray cluster, which has {free:g} left"
            )

    def _replace(self, index: int, reason: str) -> None:
        self._deaths += 1
        if self._deaths >= MOST_DEATHS * self._workers:
            raise CollectorError(
                f"{self._workers} rollout workers died {self._deaths} times without a batch in between, the last time: "
                f"{reason}"
            )
        announce(f"{self._name(index)} died and is replaced: {reason}")
        self._processes[index] = self._new_process(index)

    def _name(self, index: int) -> str:
        return f"rollout worker {index} of {self._workers}"


class Worker:
    """Plays in a process of the cluster.

    Args:
        recipe: builds the environment.
        policy: the policy with its first parameters.
        frames_per_batch, random_frames, n_steps: arguments of `Player`.
        seed: the seed of the exploration.
    """

    def __init__(
        self,
        recipe: Callable[[], ReachAvoidEnv],
        policy: PlayedPolicy,
        frames_per_batch: int,
        random_frames: int,
        n_steps: int,
        seed: int,
    ):
        torch.manual_seed(seed)
        self._policy = policy
        self._player = Player(recipe(), policy, frames_per_batch, random_frames, n_steps)

    def settle(self, initial_states: InitialStates, n_steps: int, exploration_noise: float) -> None:
        """See `Player.settle`."""
        self._player.settle(initial_states, n_steps, exploration_noise)

    def play(self, weights: dict[str, Tensor]) -> TensorDictBase:
        """The transitions of the next batch, played with these parameters of the policy."""
        self._policy.load_state_dict(weights)
        return self._player.play()
