"""The names of the files in a run directory.

.hydra/config.yaml      the configuration, with the number of its format
.hydra/overrides.yaml   the overrides of the command line
.hydra/machine.json     the commands, versions and machines that made the run
.hydra/lock             held by the process that writes into the directory, which .hydra/holder names
metrics.csv             one row of metrics for each logged update
summary.json            the verdict, the metrics of the final evaluation, and the length of the training
evaluation.json         the metrics of a later `python -m pirl_rl.evaluate`, and the settings that they depend on
certificate.json        the claims of `python -m pirl_rl.certify`
proof.json, proof.npz   what `python -m pirl_rl.certify method=interval` proved, in words and as a function
limit.json, limit.npz   what it proved of all policies, with bounds=[upper]
checkpoints/            last.pt, from which the run can be resumed, and weights-<update>.pt with the networks
grid.npz                the value and the policy on a mesh, in place of checkpoints, of a run with method=grid
figures/                PNG files
report.html             the run on one page, drawn from the other files
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

from pirl_rl.errors import CheckpointError, ConfigError

FORMAT = 2
"""The number of the current format, the key `format` of the configuration. A configuration without it has format 1."""


class RunDirectory:
    """Paths of the files of a run. Nothing is created, and the files need not exist.

    Args:
        path: the directory.
    """

    CONFIG = Path(".hydra", "config.yaml")
    OVERRIDES = Path(".hydra", "overrides.yaml")
    MACHINE = Path(".hydra", "machine.json")
    LOCK = Path(".hydra", "lock")
    HOLDER = Path(".hydra", "holder")
    METRICS = Path("metrics.csv")
    SUMMARY = Path("summary.json")
    EVALUATION = Path("evaluation.json")
    CERTIFICATE = Path("certificate.json")
    PROOF = Path("proof.json")
    BOUND = Path("proof.npz")
    LIMIT = Path("limit.json")
    LIMIT_BOUND = Path("limit.npz")
    CHECKPOINTS = Path("checkpoints")
    LAST = CHECKPOINTS / "last.pt"
    GRID = Path("grid.npz")
    FIGURES = Path("figures")
    REPORT = Path("report.html")

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)

    def __fspath__(self) -> str:
        return os.fspath(self.path)

    def __str__(self) -> str:
        return str(self.path)

    def numbers(self) -> dict[str, float]:
        """The entries of summary.json that are numbers, without the verdict's words.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is no JSON object.
        """
        try:
            entries = json.loads(self.summary.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{self.summary}: {error}") from None
        if not isinstance(entries, dict):
            raise ValueError(f"{self.summary}: expected a JSON object, got {type(entries).__name__}")
        return {name: value for name, value in entries.items() if not isinstance(value, str)}

    @property
    def config(self) -> Path:
        return self.path / self.CONFIG

    @property
    def overrides(self) -> Path:
        return self.path / self.OVERRIDES

    @property
    def machine(self) -> Path:
        """The record of how the run was made."""
        return self.path / self.MACHINE

    @property
    def lock(self) -> Path:
        return self.path / self.LOCK

    @property
    def holder(self) -> Path:
        """Names the process that holds the lock."""
        return self.path / self.HOLDER

    def unused(self) -> bool:
        """Whether the directory has nothing but what a run leaves that was killed before it had a configuration.

        These are folders without files, and the lock.
        """
        own = self.path / self.CONFIG.parent
        files = (path for path in self.path.rglob("*") if path.is_symlink() or not path.is_dir())
        return not self.config.exists() and all(own in path.parents for path in files)

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
    def certificate(self) -> Path:
        return self.path / self.CERTIFICATE

    @property
    def proof(self) -> Path:
        return self.path / self.PROOF

    @property
    def bound(self) -> Path:
        """The function that is a proved lower bound of the policy's probability of success."""
        return self.path / self.BOUND

    @property
    def limit(self) -> Path:
        return self.path / self.LIMIT

    @property
    def limit_bound(self) -> Path:
        """The function that is a proved upper bound of every policy's probability of success."""
        return self.path / self.LIMIT_BOUND

    @property
    def checkpoints(self) -> Path:
        return self.path / self.CHECKPOINTS

    @property
    def last(self) -> Path:
        """The checkpoint from which the run can be resumed."""
        return self.path / self.LAST

    @property
    def grid(self) -> Path:
        """The value and the policy of a run with method=grid."""
        return self.path / self.GRID

    @property
    def figures(self) -> Path:
        return self.path / self.FIGURES

    @property
    def report(self) -> Path:
        return self.path / self.REPORT

    def weights(self, update: int) -> Path:
        """The file with the networks after an update."""
        return self.checkpoints / f"weights-{update:09d}.pt"

    def newest(self) -> Path:
        """The file with the latest networks: `last.pt` or, in an exported directory, the last `weights-*.pt`."""
        kept = sorted(self.checkpoints.glob("weights-*.pt"))
        return kept[-1] if kept and not self.last.exists() else self.last

    def checkpoint(self, name: str) -> Path:
        """The checkpoint with a file name.

        Raises:
            CheckpointError: if the name is no plain file name.
        """
        if name in ("", "..") or Path(name).name != name:
            raise CheckpointError(f"weights: expected the name of a file in {self.checkpoints}, got {name}")
        return self.checkpoints / name

    @classmethod
    def of_checkpoint(cls, path: Path) -> RunDirectory:
        """The run directory of a file in `checkpoints/`."""
        return cls(path.parent.parent)

    def require_writable(self) -> None:
        """Refuse a directory into which no file can be written, before work that would be lost.

        Raises:
            ConfigError: with the reason of the operating system.
        """
        try:
            with tempfile.TemporaryFile(dir=self.path) as file:
                file.write(b"0")
                file.flush()  # a full disk refuses this
        except OSError as error:
            raise ConfigError(
                f"{self.path}: expected a directory that can be written, where the results are kept, got: "
                f"{error.strerror}; copy the run to another place, or measure it from Python, where "
                "pirl_rl.evaluate and run.certify write nothing"
            ) from None

    def refuse_links(self) -> None:
        """Refuse a directory whose links would make this program write outside it.

        Weights & Biases links its logs to those of its service, which may be elsewhere; nothing writes there.

        Raises:
            ConfigError: with the link that leads out of it.
        """
        root = self.path.resolve()
        for path in self.path.rglob("*"):
            folders = path.relative_to(self.path).parts[:-1]
            if folders[:1] == ("wandb",) and folders[-1] == "logs":
                continue
            if path.is_symlink() and not path.resolve().is_relative_to(root):
                raise ConfigError(f"{path}: expected no link that leads out of the run directory, to {path.resolve()}")
