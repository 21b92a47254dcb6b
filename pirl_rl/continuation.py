"""Continuation: a trainer at the state of its own last checkpoint, or at the networks of another run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from pirl_rl import checkpoint
from pirl_rl.checkpoint import check_entries, check_module
from pirl_rl.errors import ArgumentError, CheckpointError, ConfigError
from pirl_rl.renames import RULE_NAMES
from pirl_rl.run_directory import RunDirectory
from pirl_rl.trainer import Trainer


def restore(trainer: Trainer) -> None:
    """Restore the state of a trainer from the last checkpoint of its run directory.

    Raises:
        CheckpointError: if the checkpoint is missing, broken or of another configuration.
        ConfigError: if the run has already made more than `trainer.updates` updates.
    """
    assert trainer.folder is not None
    path = RunDirectory(trainer.folder).last
    state = _loaded(path)
    with fitting(path):
        expected = trainer.state_dict()
        if state.get("rollback") is None:
            del expected["rollback"]  # a resumed run may switch the guard on
        _check_learner(state, expected.pop("learner"))
        check_entries(state, expected)
    trainer.load_state_dict(state)
    if trainer.update > trainer.updates:
        message = f"expected at least {trainer.update}, which {trainer.folder} has made, got {trainer.updates}"
        raise ConfigError(f"trainer.updates: {message}")


def start_from(trainer: Trainer, start: str) -> Path:
    """Load the networks and target networks of another run into a new trainer.

    A `last.pt` also gives the optimisers and the transitions of the replay buffer, except after a collapse: those
    transitions were played by the collapsed policy.

    Args:
        trainer: the new trainer, which keeps its seeds and counts its updates from 0.
        start: a run directory, whose newest checkpoint is taken, or a file in its `checkpoints/`.

    Returns:
        The absolute path of the checkpoint.

    Raises:
        CheckpointError: if the checkpoint is missing, broken or of another configuration.
    """
    path = RunDirectory(start).newest() if Path(start).is_dir() else Path(start)
    state = _loaded(path)
    learner, buffer = trainer.learner, None
    with fitting(path):
        if "learner" in state:
            _check_learner(state, learner.state_dict())
            learner.load_state_dict(state["learner"])
        else:
            networks = checkpoint.loss_state(state)
            _check_networks(networks, learner.loss.state_dict())
            learner.loss.load_state_dict(networks)
        collapsed = (state.get("rollback") or {}).get("collapsed_at") is not None
        if "collector" in state and not collapsed:
            check_entries(state["collector"], {"buffer": {"transitions": {}, "writer": {}}}, "collector")
            buffer = state["collector"]["buffer"]
        trainer.collector.warm_start(buffer)
    return path.absolute()


def _loaded(path: Path) -> dict[str, Any]:
    """A checkpoint's state, in which the actor rule has the name of its class also if format 1 wrote a word."""
    state = checkpoint.load(path)
    if "actor_rule" in (learner := state.get("learner", {})):
        learner["actor_rule"] = RULE_NAMES.get(learner["actor_rule"], learner["actor_rule"])
    return state


def _check_learner(state: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    check_entries(state, {"learner": {"loss": {}}})
    _check_networks(state["learner"]["loss"], expected["loss"])  # other networks explain all that would follow
    check_entries(state, {"learner": {name: entry for name, entry in expected.items() if name != "loss"}})


def _check_networks(state: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Refuse other networks than the expected ones in one sentence, and spoilt ones by the name of the entry.

    Raises:
        ArgumentError: the networks differ, or an entry is not finite.
    """
    for kind, prefix in (("critics", "qvalue_network_params"), ("actor", "actor_network_params")):
        got, own = (_shapes(entries, prefix) for entries in (state, expected))
        if got != own:
            raise ArgumentError(f"its {kind} have weights of the shapes {got}, expected {own}")
    check_module(state, expected)


def _shapes(state: Mapping[str, Any], prefix: str) -> str:
    """The shapes of the weights of a network, in the order of its layers."""
    weights = [entry for name, entry in state.items() if name.startswith(prefix) and name.endswith("weight")]
    return ", ".join(str(tuple(entry.shape)) for entry in weights if isinstance(entry, torch.Tensor))


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Turn the refusal of an argument, while a checkpoint is checked or loaded, into an error that names the file.

    Raises:
        CheckpointError: if the block raises an ArgumentError.
    """
    try:
        yield
    except ArgumentError as error:
        raise CheckpointError(f"{path} does not fit the run's configuration: {error}") from error
