"""Checkpoints: `last.pt` holds everything a run needs to go on, `weights-<update>.pt` the loss module alone.

A killed run never leaves a broken one. They hold tensors and plain values only and are read with `weights_only=True`,
so that a foreign file runs no code.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import torch

from pirl_rl.errors import CheckpointError
from pirl_rl.files import replacing

FOLDER = "checkpoints"
LAST = "last.pt"
TARGET = "target_"
"""Begins the names of the target networks' parameters, which may be missing where nothing is trained further."""


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


def weights_path(folder: Path, update: int) -> Path:
    return folder / f"weights-{update:09d}.pt"


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


def restore_rng(rng: torch.Generator, state: torch.Tensor) -> None:
    """Put a random generator back where it was.

    A generator of another kind of device has other states: there it is seeded from the saved state.
    """
    if len(state) == len(rng.get_state()):
        rng.set_state(state)
    else:
        rng.manual_seed(zlib.crc32(state.numpy().tobytes()))


def newest(run: Path) -> Path:
    """The file of a run directory with its last weights: `last.pt`, or in an exported one the last `weights-*.pt`."""
    folder = run / FOLDER
    kept = sorted(folder.glob("weights-*.pt"))
    return kept[-1] if kept and not (folder / LAST).exists() else folder / LAST
