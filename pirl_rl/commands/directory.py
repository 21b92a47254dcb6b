"""The run directory of a training: how it is created, what it starts from, and what is shown of it at the end."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pirl_rl.assembly import make_trainer
from pirl_rl.commands.console import outcome
from pirl_rl.commands.start import take_start
from pirl_rl.configuration import save_config
from pirl_rl.continuation import restore
from pirl_rl.errors import ConfigError
from pirl_rl.evaluation import Evidence, lines_of, meanings_of
from pirl_rl.files import remove_folder
from pirl_rl.lock import locked
from pirl_rl.machine import record_session
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.reports.meanings import TRAINING
from pirl_rl.run_directory import RunDirectory
from pirl_rl.trainer import Trainer


def begin(
    config: DictConfig, folder: Path, overrides: Sequence[str], trust: Sequence[str], problem: ReachAvoidProblem | None
) -> Trainer:
    """The trainer of a new run, whose configuration and overrides are saved in its directory.

    Raises:
        PirlError: if the configuration cannot be built, or `start` does not fit it.
    """
    trainer = make_trainer(config, folder, trust, problem)
    if config.start is not None:
        take_start(trainer, config)
    # The configuration comes last: a directory with it counts as begun, and must tell its overrides.
    OmegaConf.save(list(overrides), RunDirectory(folder).overrides)
    save_config(config, folder)
    record_session(RunDirectory(folder), overrides, trainer.solution.device)
    return trainer


def reopen(
    config: DictConfig,
    folder: Path,
    arguments: Sequence[str],
    trust: Sequence[str],
    problem: ReachAvoidProblem | None = None,
) -> Trainer:
    """The trainer of a run that was begun, at its last checkpoint, or at update 0 without one.

    Raises:
        PirlError: if the configuration cannot be built, or the checkpoint does not fit it.
    """
    trainer = make_trainer(config, folder, trust, problem)
    if RunDirectory(folder).last.exists():
        restore(trainer)
    elif any(RunDirectory(folder).checkpoints.glob("weights-*.pt")):
        raise ConfigError(
            f"resume: expected {RunDirectory(folder).last}, got networks alone, as an export has them; start={folder} "
            "begins another run with them"
        )
    else:
        print("resume: the run has no checkpoint yet and starts again at update 0", flush=True)
        if config.get("start") is not None:
            take_start(trainer, config)
    save_config(config, folder)
    record_session(RunDirectory(folder), arguments, trainer.solution.device)
    return trainer


def show(trainer: Trainer, summary: Mapping[str, float], config: DictConfig, trust: Sequence[str]) -> None:
    """Print what a training has come to, and draw figures and report where the configuration asks for them."""
    assert trainer.folder is not None
    meanings = {"training": TRAINING} | meanings_of(trainer.final, trainer.solution.problem)
    show_run(RunDirectory(trainer.folder), trainer.solution, trainer.evidence, summary, meanings, config, trust)


def show_run(
    run: RunDirectory,
    solution: Any,
    evidence: Mapping[str, Evidence],
    summary: Mapping[str, float],
    meanings: Mapping[str, Mapping[str, str]],
    config: DictConfig,
    trust: Sequence[str],
) -> None:
    """Print the outcome of a run, and draw figures and report where the configuration asks for them.

    Args:
        run: the directory, with the files of the finished run.
        solution: the networks, or the solution of a grid, which has the same methods.
        evidence: what the last evaluation found, by the names of the evaluators.
        summary: the numbers of the run.
        meanings: what these numbers mean, by group and name.
        config: the configuration of the run.
        trust: modules outside the package that the configuration may name.
    """
    print(outcome(lines_of(evidence), summary, meanings, config.get("verbose", False)))
    if config.get("figures", True):
        from pirl_rl.figures import draw_run  # with matplotlib, which takes a second that no training should wait for

        for figure in draw_run(solution, run.metrics, run.figures, evidence):
            print(f"figure   {figure}")
    if config.get("report", True):
        from pirl_rl.commands.report import draw_again  # which draws with matplotlib as well

        draw_again(run.path, trust, solution.problem)
    print(f"run      {run}")


def own_directory(folder: Path) -> Path:
    """The directory of a run whose user has named none: the one that the clock names, or another beside it.

    Runs that begin in the same second have the same name. The first of them takes it, and the others take the first
    that is free of <name>-2, <name>-3 and so on.

    Args:
        folder: the directory that the clock names, which may exist.

    Returns:
        A directory that no other run takes. It has a folder `.hydra` and no files.

    Raises:
        ConfigError: if a file lies in its place.
    """
    refuse_files(folder)
    path, number = folder, 1
    while True:
        try:
            # Of several processes that make one folder, the operating system lets a single one succeed.
            (path / RunDirectory.CONFIG.parent).mkdir(parents=True)
            return path
        except FileExistsError:
            number += 1
            path = folder.with_name(f"{folder.name}-{number}")


@contextlib.contextmanager
def new_directory(folder: Path) -> Iterator[None]:
    """Create a run directory. It is removed if the run ends before its first row of metrics, checkpoint or grid.

    Raises:
        ConfigError: if the directory is not empty, or a file lies in its place.
        RunError: if another process has just begun a run there.
    """
    refuse_files(folder)
    folder.mkdir(parents=True, exist_ok=True)
    run = RunDirectory(folder)
    if not run.unused():
        raise ConfigError(
            f"hydra.run.dir: expected an empty directory, but {folder} is not empty, and no run overwrites files"
        )
    with locked(run):
        try:
            yield
        except BaseException:
            members = any(RunDirectory(path).config.exists() for path in folder.iterdir())
            if not members and not any(path.exists() for path in (run.metrics, run.checkpoints, run.grid)):
                remove_folder(folder)
            raise


def refuse_files(folder: Path) -> None:
    """Refuse a path of a directory on which there is a file.

    Raises:
        ConfigError: with the file.
    """
    for path in (folder, *folder.parents):
        if path.exists() and not path.is_dir():
            raise ConfigError(f"hydra.run.dir: expected a directory, but {path} is a file")
