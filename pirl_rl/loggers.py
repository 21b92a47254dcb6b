"""Loggers, which record rows of metrics. Figures, comparisons and resuming read `metrics.csv`."""

from __future__ import annotations

import csv
import netrc
import os
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from pirl_rl.errors import ArgumentError
from pirl_rl.files import replacing
from pirl_rl.run_directory import RunDirectory


class MetricsLogger(Protocol):
    """Records rows of metrics, each with the number of its update."""

    def open(self, folder: Path, config: Mapping[str, Any]) -> None:
        """Start or continue the record in a run directory; `config` is the configuration of the run."""

    def log(self, row: Mapping[str, float]) -> None:
        """Record a row; its entry "update" is the number of updates made."""

    def rewind(self, update: int) -> None:
        """Remove the rows after an update, because a resumed run writes them again."""

    def close(self) -> None:
        """Finish the record."""


class CSVLogger:
    """Writes rows to `metrics.csv`, whose columns are the entries of all rows; missing entries leave empty cells."""

    def open(self, folder: Path, config: Mapping[str, Any]) -> None:
        self.path = RunDirectory(folder).metrics
        self.columns = self._read()[0]

    def log(self, row: Mapping[str, float]) -> None:
        cells = {key: f"{value:.9g}" for key, value in row.items()}
        if row.keys() <= {*self.columns}:
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, self.columns).writerow(cells)
            return
        # The first row, or the first evaluation after the file was lost: the file is written anew with all columns.
        rows = self._read()[1]
        self.columns = self.columns + [key for key in row if key not in self.columns]
        self._write([*rows, cells])

    def rewind(self, update: int) -> None:
        rows = self._read()[1]
        if self.columns:
            self._write([row for row in rows if int(row["update"]) <= update])

    def close(self) -> None:
        pass

    def _write(self, rows: Iterable[Mapping[str, str]]) -> None:
        with replacing(self.path) as file:
            writer = csv.DictWriter(file, self.columns, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)

    def _read(self) -> tuple[list[str], list[dict[str, str]]]:
        """The columns, and the rows that a killed run did not leave incomplete; nothing where there is no header."""
        if not self.path.is_file():
            return [], []
        text = self.path.read_text(encoding="utf-8", errors="replace")
        reader = csv.DictReader(text[: text.rfind("\n") + 1].splitlines())
        columns = list(reader.fieldnames or [])
        rows = [row for row in reader if (row.get("update") or "").isdigit() and None not in row.values()]
        return (columns, rows) if "update" in columns else ([], [])


class TorchRLLogger(CSVLogger):
    """Records metrics with one of TorchRL's loggers and in `metrics.csv`.

    Args:
        kind: "tensorboard", or "wandb" for Weights & Biases. Without WANDB_MODE, WANDB_API_KEY and an account in the
            netrc file, W&B runs offline.
        project: name of the W&B project.

    Raises:
        ArgumentError: tensorboard is not installed.
    """

    def __init__(self, kind: Literal["wandb", "tensorboard"], project: str = "pirl_rl"):
        if kind == "tensorboard" and find_spec("tensorboard") is None:
            raise ArgumentError("logger: tensorboard is not installed: pip install 'pirl_rl[tensorboard]'")
        self.kind: Literal["wandb", "tensorboard"] = kind
        self.project = project

    def open(self, folder: Path, config: Mapping[str, Any]) -> None:
        # Imported here, because TorchRL's loggers import large libraries such as W&B's.
        from torchrl.record.loggers import get_logger

        super().open(folder, config)
        name, extra = str(self.kind), dict[str, Any]()
        if self.kind == "wandb":
            name = folder.name
            os.environ.setdefault("WANDB_CACHE_DIR", str(folder / "wandb" / "cache"))
            offline = "WANDB_MODE" not in os.environ and not _has_wandb_account()
            # The members of a population are open at once, each as a run of its own.
            options = {"project": self.project, "offline": offline, "config": dict(config), "reinit": "create_new"}
            # A run that is resumed goes on as the same run of W&B, also with other settings.
            options |= {"id": _wandb_id(folder), "allow_val_change": True}
            extra = {"wandb_kwargs": options}
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
    """Records nothing."""

    def open(self, folder: Path, config: Mapping[str, Any]) -> None:
        pass

    def log(self, row: Mapping[str, float]) -> None:
        pass

    def rewind(self, update: int) -> None:
        pass

    def close(self) -> None:
        pass


def read_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """Read the columns of a `metrics.csv`, by name.

    Returns:
        Arrays (rows,) of floats, NaN where a cell is empty.

    Raises:
        OSError: the file cannot be read.
        ValueError: a cell is not a number.
    """
    with open(path, newline="") as file:
        rows = csv.DictReader(file)
        names, cells = rows.fieldnames or [], list(rows)
    return {name: np.array([float(row[name] or "nan") for row in cells]) for name in names}


def _wandb_id(folder: Path) -> str | None:
    """The id of the run of W&B in a run directory, which the names of its folders end with; None if there is none."""
    names = sorted(path.name.removeprefix("offline-") for path in folder.glob("wandb/*run-*-*"))
    return names[-1].rpartition("-")[2] if names else None


def _has_wandb_account() -> bool:
    if os.environ.get("WANDB_API_KEY"):
        return True
    try:
        return any("wandb" in host for host in netrc.netrc().hosts)
    except (OSError, netrc.NetrcParseError):
        return False
