"""A run directory: the one place that knows the names of its files.

.hydra/config.yaml      the configuration, with the number of its format
.hydra/overrides.yaml   the settings that were typed
metrics.csv             rows of metrics over updates
summary.json            the numbers of the final evaluation
evaluation.json         those of a later `python -m pirl_rl.evaluate`
checkpoints/            last.pt, from which the run goes on, and weights-<update>.pt
figures/                PNG files
"""

from __future__ import annotations

import os
from pathlib import Path

from pirl_rl.errors import CheckpointError, ConfigError

FORMAT = 2
"""Version of what a run directory holds, the key `format` of its configuration; 1 where that has no such key."""


class RunDirectory:
    """Paths of the files of one run; nothing is created, and a file need not exist.

    Args:
        path: the directory.
    """

    CONFIG = Path(".hydra", "config.yaml")
    OVERRIDES = Path(".hydra", "overrides.yaml")
    METRICS = Path("metrics.csv")
    SUMMARY = Path("summary.json")
    EVALUATION = Path("evaluation.json")
    CHECKPOINTS = Path("checkpoints")
    LAST = CHECKPOINTS / "last.pt"
    FIGURES = Path("figures")

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)

    def __fspath__(self) -> str:
        return os.fspath(self.path)

    def __str__(self) -> str:
        return str(self.path)

    @property
    def config(self) -> Path:
        return self.path / self.CONFIG

    @property
    def overrides(self) -> Path:
        return self.path / self.OVERRIDES

    @property
    def metrics(self) -> Path:
        return self.path / self.METRICS

    @property
    def summary(self) -> Path:
        return self.path / self.SUMMARY

    @property
    def evaluation(self) -> Path:
        return self.path / self.EVALUATION

    @property
    def checkpoints(self) -> Path:
        return self.path / self.CHECKPOINTS

    @property
    def last(self) -> Path:
        """The checkpoint from which the run goes on."""
        return self.path / self.LAST

    @property
    def figures(self) -> Path:
        return self.path / self.FIGURES

    def weights(self, update: int) -> Path:
        """The networks alone, as they were after an update."""
        return self.checkpoints / f"weights-{update:09d}.pt"

    def newest(self) -> Path:
        """The file with the run's last networks: `last.pt`, or in an exported directory the last `weights-*.pt`."""
        kept = sorted(self.checkpoints.glob("weights-*.pt"))
        return kept[-1] if kept and not self.last.exists() else self.last

    def checkpoint(self, name: str) -> Path:
        """The file of that name among the checkpoints.

        Raises:
            CheckpointError: the name leads elsewhere.
        """
        if name in ("", "..") or Path(name).name != name:
            raise CheckpointError(f"weights: expected the name of a file in {self.checkpoints}, got {name}")
        return self.checkpoints / name

    @classmethod
    def of_checkpoint(cls, path: Path) -> RunDirectory:
        """The run that a file in `checkpoints/` belongs to."""
        return cls(path.parent.parent)

    def refuse_links(self) -> None:
        """Refuse a directory from elsewhere that would make us write outside it.

        Raises:
            ConfigError: naming a link that leads out of it.
        """
        root = self.path.resolve()
        for path in self.path.rglob("*"):
            if path.is_symlink() and not path.resolve().is_relative_to(root):
                raise ConfigError(f"{path} leads out of the run directory, to {path.resolve()}")
