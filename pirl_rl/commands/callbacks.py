"""Callbacks that Hydra calls before and after a sweep."""

from __future__ import annotations

import atexit
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from pirl_rl.files import remove_folder


class TidySweep(Callback):
    """Removes the directory of a sweep if no job of it started, for example because of a mistyped setting."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        atexit.register(_remove_if_bare, Path(config.hydra.sweep.dir).absolute())


def _remove_if_bare(folder: Path) -> None:
    if folder.is_dir() and [path.name for path in folder.iterdir()] == ["multirun.yaml"]:
        remove_folder(folder)
