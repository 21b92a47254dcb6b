"""Checkpoints: `last.pt` has everything that resuming a run needs, `weights-<update>.pt` the loss module alone.

They are written atomically, so that a killed run leaves no broken file. They contain only tensors and plain values and
are read with `weights_only=True`, so that loading an untrusted file runs no code.
"""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pirl_rl.errors import ArgumentError, CheckpointError
from pirl_rl.files import replacing

TARGET = "target_"
"""Prefix of the names of the target networks' parameters, which a checkpoint for inference alone may lack."""


def save(state: dict[str, Any], path: Path) -> None:
    """Write a state, a dictionary of tensors and plain values, atomically.

    Raises:
        OSError: the file cannot be written, as on a full disk; the file before stays.
    """
    with replacing(path, binary=True) as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:  # by which torch reports a failed write, such as that on a full disk
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def load(path: Path) -> dict[str, Any]:
    """Read a state; its tensors are on the CPU.

    Raises:
        CheckpointError: the file is missing, damaged, or not a checkpoint of this package.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}")
    _check_sums(path)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the exception depends on what the file contains
        reason = str(error).partition("\n")[0].partition(". ")[0] or type(error).__name__
        raise CheckpointError(f"{path} is not a checkpoint, expected tensors and plain values: {reason}") from None
    if not isinstance(state, dict) or not isinstance(loss := state.get("learner", state), dict) or "loss" not in loss:
        raise CheckpointError(f"{path} is not a checkpoint of pirl_rl: it has no loss module")
    return state


def _check_sums(path: Path) -> None:
    """Compare every entry of an archive with the checksum that `torch.save` wrote, which `torch.load` does not."""
    if not zipfile.is_zipfile(path):
        return
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except Exception as error:  # the exception depends on which bytes are damaged
        raise CheckpointError(f"{path} is damaged: {error}") from None
    if damaged is not None:
        raise CheckpointError(f"{path} is damaged: the checksum of its entry {damaged} is wrong")


def loss_state(state: dict[str, Any]) -> dict[str, Any]:
    """The state of the loss module in a checkpoint; missing target networks are copies of the networks."""
    loss = state.get("learner", state)["loss"]
    own = {name: entry for name, entry in loss.items() if "network_params" in name and not name.startswith(TARGET)}
    return {f"{TARGET}{name}": entry for name, entry in own.items()} | loss


def network_states(state: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The states of the actor and of the stacked critics in a checkpoint, with the names that their modules use."""
    loss = state.get("learner", state)["loss"]
    prefixes = ("actor_network_params.module.", "qvalue_network_params.module.")
    actor, critics = (
        {name.removeprefix(prefix): entry for name, entry in loss.items() if name.startswith(prefix)}
        for prefix in prefixes
    )
    return actor, critics


def check_module(state: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Refuse networks whose entries have other names or shapes than the module's, or are not finite.

    Args:
        state: the state in the checkpoint; it may have target networks that the module does not have.
        expected: the state of the module.

    Raises:
        ArgumentError: an entry is missing, unexpected, of another shape or not finite; the message names the first one.
    """
    check_entries(state, expected, "loss")
    for name in state.keys() - expected.keys():
        if not name.startswith(TARGET):
            raise ArgumentError(f"loss.{name}: expected no such entry, got one")
    for name, entry in state.items():
        if isinstance(entry, torch.Tensor) and not bool(entry.isfinite().all()):
            raise ArgumentError(f"loss.{name}: expected finite numbers, got NaN or infinite ones")


def check_entries(state: Any, expected: Any, key: str = "") -> None:
    """Refuse a state that lacks an entry of the expected state, or has a tensor of another shape there.

    Further entries are allowed. The states of random generators are not compared, because their sizes depend on the
    device.

    Args:
        state: the state in the checkpoint, or a part of it.
        expected: the state that it must match, or the same part of it.
        key: the name of that part, for messages.

    Raises:
        ArgumentError: an entry is missing or of another type or shape; the message names the first one.
    """
    if key.endswith("rng"):
        return
    if isinstance(expected, Mapping):
        if not isinstance(state, Mapping):
            raise ArgumentError(f"{key}: expected a mapping, got {type(state).__name__}")
        for name, entry in expected.items():
            if name not in state:
                raise ArgumentError(
                    f"no entry {f'{key}.{name}'.lstrip('.')}, expected one; to take over the networks alone, start "
                    "from a file checkpoints/weights-*.pt"
                )
            check_entries(state[name], entry, f"{key}.{name}".lstrip("."))
    elif isinstance(expected, list):
        if not isinstance(state, list) or len(state) != len(expected):
            got = len(state) if isinstance(state, list) else type(state).__name__
            raise ArgumentError(f"{key}: expected {len(expected)} entries, got {got}")
        for index, pair in enumerate(zip(state, expected, strict=True)):
            check_entries(*pair, f"{key}[{index}]")
    elif isinstance(expected, torch.Tensor):
        shape = tuple(state.shape) if isinstance(state, torch.Tensor) else type(state).__name__
        if shape != tuple(expected.shape):
            raise ArgumentError(f"{key}: expected shape {tuple(expected.shape)}, got {shape}")


def digest(arrays: Mapping[str, np.ndarray]) -> str:
    """The SHA-256 of arrays with their names, dtypes and shapes, in hexadecimal digits."""
    total = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        total.update(f"{name} {array.dtype} {array.shape}".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def restore_rng(rng: torch.Generator, state: torch.Tensor) -> None:
    """Restore the state of a random generator.

    The state of a generator on another kind of device has another size; `rng` is then seeded from a checksum of it.
    """
    if len(state) == len(rng.get_state()):
        rng.set_state(state)
    else:
        rng.manual_seed(zlib.crc32(state.numpy().tobytes()))


def global_rng_states() -> dict[str, Any]:
    """The states of torch's global random generators, of the CPU and of all CUDA devices."""
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {"torch_rng": torch.get_rng_state(), "cuda_rng": cuda}


def restore_global_rngs(state: Mapping[str, Any]) -> None:
    """Restore what `global_rng_states` returned; those of CUDA only on a machine with as many devices."""
    torch.set_rng_state(state["torch_rng"])
    if len(state["cuda_rng"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(state["cuda_rng"])
