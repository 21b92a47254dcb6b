"""Checkpoints: `last.pt` holds everything a run needs to go on, `weights-<update>.pt` the loss module alone.

Files are written beside their place, flushed and moved into it in one step, so that a killed run never leaves a broken
one; they hold tensors and plain values only and are read with `weights_only=True`, so that a foreign file runs no code.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import torch

LAST = "last.pt"


class CheckpointError(RuntimeError):
    """A checkpoint that is missing, broken or not one of ours; the message names the file."""


def save(state: dict[str, Any], path: Path) -> None:
    """Write a state atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.draft")
    with draft.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(draft, path)


def load(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a state.

    Raises:
        CheckpointError: with the file and the reason.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}")
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"{path} is not a checkpoint of tensors and plain values: {reason}") from None
    if not isinstance(state, dict) or "loss" not in state.get("learner", state):
        raise CheckpointError(f"{path} is not a checkpoint of pirl_rl: it holds no loss module")
    return state


def weights_path(folder: Path, update: int) -> Path:
    return folder / f"weights-{update:09d}.pt"
