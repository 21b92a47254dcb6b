"""Export a run.

    python -m pirl_rl.export run=RUN_DIR out=FOLDER

Copies the files that `load_run` and a reader need: the networks without target networks, replay buffer and optimisers,
the configuration, the summary, the certificate, the metrics and the figures.

    run  the run directory
    out  a new folder

Examples:
    python -m pirl_rl.export run=runs/drift/2026-01-31_12-00-00-0 out=my_model
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from pirl_rl import checkpoint
from pirl_rl.checkpoint import TARGET
from pirl_rl.commands.console import reported
from pirl_rl.configuration import load_config, save_config
from pirl_rl.errors import ConfigError
from pirl_rl.progress import helped
from pirl_rl.run_directory import RunDirectory

COPIED = (
    RunDirectory.SUMMARY,
    RunDirectory.EVALUATION,
    RunDirectory.CERTIFICATE,
    RunDirectory.PROOF,
    RunDirectory.BOUND,
    RunDirectory.METRICS,
    RunDirectory.FIGURES,
)


def export(run: Path, out: Path) -> Path:
    """Export a run to a new folder.

    Args:
        run: the run directory.
        out: the folder, which must not exist.

    Returns:
        The path of the exported networks.

    Raises:
        ConfigError: if `run` is not a run directory, or `out` exists.
        CheckpointError: if the checkpoint is missing or broken.
    """
    config = load_config(run)
    source = RunDirectory(run)
    state = checkpoint.load(source.newest())
    source.refuse_links()
    if out.exists():
        raise ConfigError(f"out: expected a new folder, but {out} exists, and an export never overwrites anything")
    if "start" in config:
        config.start = None  # a path that means nothing elsewhere
    # The folder gets its name at the end, so that an export that is killed leaves none that looks complete.
    draft = out.with_name(f".{out.name}.draft")
    shutil.rmtree(draft, ignore_errors=True)
    try:
        path = _write(source, config, state, RunDirectory(draft))
        draft.rename(out)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise
    return out / path.relative_to(draft)


def _write(source: RunDirectory, config: DictConfig, state: dict[str, Any], copy: RunDirectory) -> Path:
    """Write the files of an export; returns the path of the networks."""
    save_config(config, copy.path)
    loss = {name: entry for name, entry in checkpoint.loss_state(state).items() if not name.startswith(TARGET)}
    path = copy.weights(state["update"])
    checkpoint.save({"loss": loss, "update": state["update"]}, path)
    for name in COPIED:
        if (source.path / name).is_dir():
            shutil.copytree(source.path / name, copy.path / name)
        elif (source.path / name).is_file():
            shutil.copyfile(source.path / name, copy.path / name)
    return path


def main(arguments: Sequence[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    if helped(arguments, __doc__):
        return
    named = dict(item.split("=", 1) for item in arguments if "=" in item)
    with reported(Path(named.get("run", "."))):
        if set(named) != {"run", "out"} or len(named) != len(arguments):
            raise ConfigError(f"expected run=RUN_DIR out=FOLDER, got {' '.join(arguments) or 'nothing'}")
        path = export(Path(named["run"]), Path(named["out"]))
    print(f"written  {path}")
