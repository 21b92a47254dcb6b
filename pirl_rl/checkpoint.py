"""Checkpoints: `last.pt` holds everything a run needs to go on, `weights-<update>.pt` the loss module alone.

A killed run never leaves a broken one. They hold tensors and plain values only and are read with `weights_only=True`,
so that a foreign file runs no code.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from pirl_rl.errors import ArgumentError, CheckpointError
from pirl_rl.files import replacing

TARGET = "target_"
"""Prefix of the names of the target networks' parameters, which may be missing where nothing is trained further."""


def save(state: dict[str, Any], path: Path) -> None:
    """Write a state atomically."""
    with replacing(path, binary=True) as file:
        torch.save(state, file)


def load(path: Path) -> dict[str, Any]:
    """Read a state, to the CPU: its users move it where they are.

    Raises:
        CheckpointError: with the file and the reason.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a foreign file may be wrong in any way
        reason = str(error).partition("\n")[0].partition(". ")[0] or type(error).__name__
        raise CheckpointError(f"{path} is not a checkpoint of tensors and plain values: {reason}") from None
    if not isinstance(state, dict) or not isinstance(loss := state.get("learner", state), dict) or "loss" not in loss:
        raise CheckpointError(f"{path} is not a checkpoint of pirl_rl: it holds no loss module")
    return state


def loss_state(state: dict[str, Any]) -> dict[str, Any]:
    """The loss module's state; the networks themselves stand for targets that are missing."""
    loss = state.get("learner", state)["loss"]
    own = {name: entry for name, entry in loss.items() if "network_params" in name and not name.startswith(TARGET)}
    return {f"{TARGET}{name}": entry for name, entry in own.items()} | loss


def network_states(state: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The entries of the actor and of the stacked critics in a checkpoint, named as in their modules."""
    loss = state.get("learner", state)["loss"]
    prefixes = ("actor_network_params.module.", "qvalue_network_params.module.")
    actor, critics = (
        {name.removeprefix(prefix): entry for name, entry in loss.items() if name.startswith(prefix)}
        for prefix in prefixes
    )
    return actor, critics


def check_module(state: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Refuse networks of other names or shapes; targets that the module does not have are left out by it.

    Args:
        state: of the checkpoint.
        expected: the module's own state.

    Raises:
        ArgumentError: naming the first entry that is missing, too many, or of another shape.
    """
    check_entries(state, expected, "loss")
    for name in state.keys() - expected.keys():
        if not name.startswith(TARGET):
            raise ArgumentError(f"loss.{name}: expected no such entry")


def check_entries(state: Any, expected: Any, key: str = "") -> None:
    """Refuse a state that lacks an entry of the expected one, or has a tensor of another shape; it may hold more.

    States of random generators depend on their device and are not compared.

    Raises:
        ArgumentError: naming the first such entry.
    """
    if key.endswith("rng"):
        return
    if isinstance(expected, Mapping):
        if not isinstance(state, Mapping):
            raise ArgumentError(f"{key}: expected a mapping, got {type(state).__name__}")
        for name, entry in expected.items():
            if name not in state:
                raise ArgumentError(
                    f"no entry {f'{key}.{name}'.lstrip('.')}; a file of checkpoints/weights-* holds networks alone and "
                    "may still do"
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


def restore_rng(rng: torch.Generator, state: torch.Tensor) -> None:
    """Put a random generator back where it was.

    A generator of another kind of device has other states: there it is seeded from the saved state.
    """
    if len(state) == len(rng.get_state()):
        rng.set_state(state)
    else:
        rng.manual_seed(zlib.crc32(state.numpy().tobytes()))
