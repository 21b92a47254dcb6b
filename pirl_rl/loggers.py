"""Loggers: where the rows of metrics go. `metrics.csv` is what figures, comparisons and resuming read."""

from __future__ import annotations

import csv
import netrc
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from pirl_rl.files import replacing
from pirl_rl.run_directory import RunDirectory


class MetricsLogger(Protocol):
    """Takes a row of numbers for an update."""

    def open(self, folder: Path, config: Mapping[str, Any]) -> None:
        """Begin, or go on, in a run directory."""

    def log(self, row: Mapping[str, float]) -> None: ...

    def rewind(self, update: int) -> None:
        """Forget rows after an update: a resumed run writes them again."""

    def close(self) -> None: ...


class CSVLogger:
    """One row an update in `metrics.csv`; its columns are those of the first row, cells may stay empty."""

    def open(self, folder: Path, config: Mapping[str, Any]) -> None:
        self.path = RunDirectory(folder).metrics
        self.columns = self._read()[0]

    def log(self, row: Mapping[str, float]) -> None:
        new = not self.columns
        self.columns = self.columns or list(row)
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, self.columns, extrasaction="ignore")
            if new:
                writer.writeheader()
            writer.writerow({key: f"{value:.9g}" for key, value in row.items()})

    def rewind(self, update: int) -> None:
        columns, rows = self._read()
        if not columns:
            return
        with replacing(self.path) as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            # A row cut short by a kill has no update, or one that comes again.
            writer.writerows(row for row in rows if (row["update"] or "").isdigit() and int(row["update"]) <= update)

    def close(self) -> None:
        pass

    def _read(self) -> tuple[list[str], list[dict[str, str]]]:
        if not self.path.is_file():
            return [], []
        with self.path.open(newline="") as file:
            reader = csv.DictReader(file)
            return list(reader.fieldnames or []), list(reader)


class TorchRLLogger(CSVLogger):
    """One of TorchRL's loggers beside `metrics.csv`.

    Args:
        kind: "wandb" (offline where neither WANDB_API_KEY nor a netrc entry names an account) or "tensorboard".
        project: name of the W&B project.
    """

    def __init__(self, kind: Literal["wandb", "tensorboard"], project: str = "pirl_rl"):
        self.kind: Literal["wandb", "tensorboard"] = kind
        self.project = project

    def open(self, folder: Path, config: Mapping[str, Any]) -> None:
        # Only here: TorchRL's loggers bring their libraries with them, among them W&B's.
        from torchrl.record.loggers import get_logger

        super().open(folder, config)
        name, extra = str(self.kind), dict[str, Any]()
        if self.kind == "wandb":
            name = folder.name
            os.environ.setdefault("WANDB_CACHE_DIR", str(folder / "wandb" / "cache"))
            offline = "WANDB_MODE" not in os.environ and not _has_wandb_account()
            extra = {"wandb_kwargs": {"project": self.project, "offline": offline, "config": dict(config)}}
        self.logger: Any = get_logger(self.kind, logger_name=str(folder), experiment_name=name, **extra)

    def log(self, row: Mapping[str, float]) -> None:
        super().log(row)
        for name, value in row.items():
            if name != "update":
                self.logger.log_scalar(name, value, step=int(row["update"]))

    def close(self) -> None:
        if self.kind == "wandb":
            self.logger.experiment.finish()
        else:
            self.logger.experiment.close()


class NoLogger:
    """Keeps nothing; the run has no curves."""

    def open(self, folder: Path, config: Mapping[str, Any]) -> None:
        pass

    def log(self, row: Mapping[str, float]) -> None:
        pass

    def rewind(self, update: int) -> None:
        pass

    def close(self) -> None:
        pass


def read_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """The columns of a metrics.csv as float arrays (rows,), NaN where a cell is empty.

    Raises:
        OSError, ValueError: the file cannot be read, or a cell is no number.
    """
    with open(path, newline="") as file:
        rows = csv.DictReader(file)
        names, cells = rows.fieldnames or [], list(rows)
    return {name: np.array([float(row[name] or "nan") for row in cells]) for name in names}


def _has_wandb_account() -> bool:
    if os.environ.get("WANDB_API_KEY"):
        return True
    try:
        return any("wandb" in host for host in netrc.netrc().hosts)
    except (OSError, netrc.NetrcParseError):
        return False
