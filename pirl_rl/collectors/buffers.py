"""Making, saving and restoring the replay buffer of a collector."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from pirl_rl.checkpoint import restore_rng
from pirl_rl.collectors.transitions import TRANSITION
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.errors import ArgumentError


def check_sizes(
    env: ReachAvoidEnv, frames_per_batch: int, updates_per_batch: int, warmup_frames: int, buffer_size: int
) -> None:
    """Check the sizes that all collectors have.

    Raises:
        ArgumentError: a size is out of range; the message names it.
    """
    envs = env.batch_size[0]
    if frames_per_batch % envs or frames_per_batch < envs:
        raise ArgumentError(
            f"collector.frames_per_batch: expected a multiple of env.num_envs = {envs}, got {frames_per_batch}"
        )
    if updates_per_batch < 1 or warmup_frames < 1:
        raise ArgumentError(
            f"collector: expected updates_per_batch and warmup_frames >= 1, got {updates_per_batch} and {warmup_frames}"
        )
    if buffer_size < frames_per_batch:
        raise ArgumentError(
            f"collector.buffer_size: expected at least frames_per_batch = {frames_per_batch}, got {buffer_size}"
        )


def make_buffer(
    size: int, device: torch.device, seed: int, shared: bool = False
) -> tuple[TensorDictReplayBuffer, torch.Generator]:
    """A replay buffer, and the random generator with which it is sampled.

    A shared buffer does not have the generator yet, since it does not survive being sent to another process.
    """
    storage = LazyTensorStorage(size, device=device, shared_init=shared)
    buffer = TensorDictReplayBuffer(storage=storage, shared=shared)
    rng = torch.Generator(device).manual_seed(seed)
    if not shared:
        buffer.set_rng(rng)
    return buffer, rng


def buffer_state(buffer: TensorDictReplayBuffer, rng: torch.Generator) -> dict[str, Any]:
    """The state of a buffer and of its random generator, as tensors and plain values."""
    # Memory-mapped tensors are a class of their own, which a checkpoint of plain tensors cannot contain.
    plain = buffer[:].apply(lambda entry: entry.as_subclass(torch.Tensor)) if len(buffer) else TensorDict()
    return {
        "transitions": plain.to_dict(),
        "writer": buffer.writer.state_dict(),
        "rng": rng.get_state(),
    }


def fill_buffer(
    buffer: TensorDictReplayBuffer, device: torch.device, env: ReachAvoidEnv, state: dict[str, Any]
) -> None:
    """Copy the transitions of another buffer's state into an empty buffer; if it is smaller, the newest ones.

    Args:
        buffer: the empty buffer.
        device: the device of the buffer.
        env: an environment with which the transitions must agree.
        state: the state of the other buffer, see `buffer_state`.

    Raises:
        ArgumentError: the transitions lack an entry or have another shape than those of the environment.
    """
    if not state["transitions"]:
        return
    transitions = TensorDict(state["transitions"]).auto_batch_size_(1)
    example = env.fake_tensordict()
    example = example.set("loc", example["action"]).select(*TRANSITION)
    for key in TRANSITION:
        if key not in transitions.keys(True):
            raise ArgumentError(
                f"replay buffer: no entry {key}, expected one; to take over the networks alone, start from a file "
                "checkpoints/weights-*.pt"
            )
        got, expected = (entry[key].shape[1:] for entry in (transitions, example))
        if got != expected:
            raise ArgumentError(f"replay buffer, {key}: expected shape {tuple(expected)}, got {tuple(got)}")
    count, size = len(transitions), buffer.storage.max_size
    order = (torch.arange(count) + state["writer"]["_cursor"]) % count  # in a full buffer, the oldest is at the cursor
    buffer.extend(transitions.select(*TRANSITION)[order[-size:]].to(device))


def load_buffer(buffer: TensorDictReplayBuffer, rng: torch.Generator, state: dict[str, Any]) -> None:
    """Restore an empty buffer from its state; unlike TorchRL's method, this keeps its device and its shared memory."""
    if state["transitions"]:
        transitions = TensorDict(state["transitions"]).auto_batch_size_(1)
        buffer.extend(transitions.to(rng.device))
    buffer.writer.load_state_dict(state["writer"])
    restore_rng(rng, state["rng"])
