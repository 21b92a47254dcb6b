"""What a new run takes from the run that `start` names: the settings of its networks, and the networks themselves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.utils import to_absolute_path
from omegaconf import DictConfig, OmegaConf

from pirl_rl.configuration import load_config
from pirl_rl.continuation import start_from
from pirl_rl.errors import CheckpointError, ConfigError
from pirl_rl.run_directory import RunDirectory
from pirl_rl.trainer import Trainer

NETWORKS = ("actor", "critic")
"""The nodes of the configuration that build the networks."""


def adopt_networks(config: DictConfig, typed: Sequence[str]) -> None:
    """Give the networks of a new run the settings that they have in the run that `start` names.

    Settings that were typed stay, and all of them if that run has another method, whose networks may be of another
    kind, or if its configuration is not at hand.

    Args:
        config: the composed configuration; changed in place.
        typed: the overrides that were typed.
    """
    other = _config_of(config.start)
    if other is None or other.get("method_name") != config.method_name:
        return
    keys = {text.partition("=")[0].lstrip("+~") for text in typed}
    kept = {key: OmegaConf.select(config, key) for key in keys if key.partition(".")[0] in NETWORKS}
    for name in (name for name in NETWORKS if name in other):
        OmegaConf.update(config, name, OmegaConf.to_container(other[name], resolve=True), merge=False)
    for key, value in kept.items():
        OmegaConf.update(config, key, value, force_add=True)


def absolute_start(config: DictConfig) -> None:
    """Make a relative `start` absolute where Hydra has changed the directory, as `hydra.job.chdir=true` lets it.

    Args:
        config: the configuration of a command of Hydra; changed in place.
    """
    if HydraConfig.get().job.chdir and isinstance(config.start, str):
        config.start = to_absolute_path(config.start)


def take_start(trainer: Trainer, config: DictConfig) -> None:
    """Take the networks of another run, and record the file in the configuration.

    The absolute path of the file is recorded: the given path may be relative, or that of a run directory whose newest
    checkpoint changes when the run is resumed.

    Raises:
        ConfigError: if `start` is no path.
        CheckpointError: if the networks do not fit; the message names the method of the other run where it differs.
    """
    start = config.start
    if not isinstance(start, str):
        raise ConfigError(f"start: expected the path of a run or a checkpoint, got {start!r}")
    try:
        config.start = str(start_from(trainer, start))
    except CheckpointError as error:
        method = method_of(start)
        if method in (None, config.method_name):
            raise
        raise CheckpointError(
            f"{error}; that run had method={method} and this one has method={config.method_name}, whose networks may "
            f"differ: give method={method}, or start from a run with method={config.method_name}"
        ) from None


def method_of(start: str) -> str | None:
    """The method of the run that a directory or a file in its `checkpoints/` belongs to; None if it is not known."""
    other = _config_of(start)
    return None if other is None else other.get("method_name")


def _config_of(start: object) -> DictConfig | None:
    """The configuration of the run that a directory or a file in its `checkpoints/` belongs to, if it is at hand."""
    if not isinstance(start, str):
        return None
    run = RunDirectory(start) if Path(start).is_dir() else RunDirectory.of_checkpoint(Path(start))
    return load_config(run.path) if run.config.is_file() else None
