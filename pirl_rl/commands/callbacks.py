"""What Hydra calls around a multirun."""

from __future__ import annotations

import atexit
import contextlib
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig


class TidySweep(Callback):
    """A sweep of which no job began, as with a mistyped setting, leaves no directory."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        atexit.register(_remove_if_bare, Path(config.hydra.sweep.dir).absolute())


def _remove_if_bare(folder: Path) -> None:
    if folder.is_dir() and [path.name for path in folder.iterdir()] == ["multirun.yaml"]:
        (folder / "multirun.yaml").unlink()
        with contextlib.suppress(OSError):
            folder.rmdir()
            for parent in (folder.parent, folder.parent.parent):
                parent.rmdir()  # empty ones only
