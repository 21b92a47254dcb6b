"""Export a run.

    python -m pirl_rl.export run=RUN_DIR out=FOLDER [format=run|onnx|torch]

As a run, copies the files that `load_run` and a reader need: the networks without target networks, replay buffer and
optimisers, or the mesh of a grid; the configuration, the summary, the certificate, the metrics and the figures. As a
model, writes V, its gradient and the policy as one function of the time to go and the state, which needs nothing of
this package.

    run     the run directory
    out     a new folder
    format  run: a small run directory, the default;
            onnx: model.onnx, which onnxruntime executes, and its description model.json;
            torch: model.pt2, which torch.export.load opens, and its description model.json
    trust   modules of your own that the run may import, such as trust=[my_module]

Examples:
    python -m pirl_rl.export run=runs/drift/2026-01-31_12-00-00-0 out=my_model
    python -m pirl_rl.export run=models/drift out=drift_onnx format=onnx
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from pirl_rl import checkpoint
from pirl_rl.building import trusted_modules
from pirl_rl.checkpoint import TARGET
from pirl_rl.commands.console import program, reported
from pirl_rl.configuration import load_config, save_config
from pirl_rl.deployment import FORMATS, write_model
from pirl_rl.errors import CheckpointError, ConfigError
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.load import load_run

COPIED = (
    RunDirectory.SUMMARY,
    RunDirectory.EVALUATION,
    RunDirectory.CERTIFICATE,
    RunDirectory.PROOF,
    RunDirectory.BOUND,
    RunDirectory.LIMIT,
    RunDirectory.LIMIT_BOUND,
    RunDirectory.METRICS,
    RunDirectory.FIGURES,
    RunDirectory.GRID,
)


def export(run: Path, out: Path) -> Path:
    """Export a run to a new folder.

    Args:
        run: the run directory.
        out: the folder, which must not exist.

    Returns:
        The path of the exported networks, or of the grid.

    Raises:
        ConfigError: if `run` is not a run directory, or `out` exists.
        CheckpointError: if the checkpoint or the grid is missing or broken.
    """
    config = load_config(run)
    source = RunDirectory(run)
    of_grid = config.get("grid") is not None
    if of_grid and not source.grid.is_file():
        raise CheckpointError(f"no grid at {source.grid}")
    state = None if of_grid else checkpoint.load(source.newest())
    source.refuse_links()
    if "start" in config:
        config.start = None  # a path that means nothing elsewhere
    with _drafted(out) as draft:
        path = _write(source, config, state, RunDirectory(draft))
    return out / path.relative_to(draft)


def export_model(run: Path, out: Path, kind: str, trust: Sequence[str] = ()) -> Path:
    """Export V, its gradient and the policy of a run to a new folder, as a model that needs nothing of this package.

    Args:
        run: the run directory.
        out: the folder, which must not exist.
        kind: a format of models, see `pirl_rl.deployment`.
        trust: modules outside pirl_rl that the configuration of the run may name.

    Returns:
        The path of the model.

    Raises:
        ConfigError: if `run` is not a run directory or the run of a grid, or `out` exists.
        ArgumentError: if the format is unknown, a package is missing, or the problem cannot be recorded as a graph.
        CheckpointError: if the checkpoint is missing or broken.
    """
    if load_config(run).get("grid") is not None:
        raise ConfigError(
            f"format: expected format=run for a run with method=grid, whose V and policy are tables on a mesh and no "
            f"networks, got {kind}"
        )
    with _drafted(out) as draft:
        path = write_model(load_run(run, trust).solution, kind, draft)
    return out / path.relative_to(draft)


@contextlib.contextmanager
def _drafted(out: Path) -> Iterator[Path]:
    """A draft of the folder `out`, which gets its name at the end of the block and is removed if the block raises.

    An export that is killed thus leaves no folder that looks complete.

    Raises:
        ConfigError: if `out` exists.
    """
    if out.exists():
        raise ConfigError(f"out: expected a new folder, but {out} exists, and an export never overwrites anything")
    draft = out.with_name(f".{out.name}.draft")
    shutil.rmtree(draft, ignore_errors=True)
    try:
        yield draft
        draft.rename(out)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def _write(source: RunDirectory, config: DictConfig, state: dict[str, Any] | None, copy: RunDirectory) -> Path:
    """Write the files of an export; returns the path of the networks, or without their state that of the grid."""
    save_config(config, copy.path)
    path = copy.grid
    if state is not None:
        loss = {name: entry for name, entry in checkpoint.loss_state(state).items() if not name.startswith(TARGET)}
        path = copy.weights(state["update"])
        checkpoint.save({"loss": loss, "update": state["update"]}, path)
    for name in COPIED:
        if (source.path / name).is_dir():
            shutil.copytree(source.path / name, copy.path / name)
        elif (source.path / name).is_file():
            shutil.copyfile(source.path / name, copy.path / name)
    return path


@program
def main(arguments: Sequence[str]) -> None:
    named = dict(item.split("=", 1) for item in arguments if "=" in item)
    with reported(Path(named.get("run", "."))):
        if not {"run", "out"} <= {*named} <= {"run", "out", "format", "trust"} or len(named) != len(arguments):
            raise ConfigError(
                "expected run=RUN_DIR out=FOLDER, and if needed format=run|onnx|torch and trust=[my_module], got "
                f"{' '.join(arguments) or 'nothing'}"
            )
        run, out, kind = Path(named["run"]), Path(named["out"]), named.get("format", "run")
        if kind not in ("run", *FORMATS):
            raise ConfigError(f"format: expected one of run, {', '.join(FORMATS)}, got {kind}")
        if kind == "run":
            path = export(run, out)
        else:
            path = export_model(run, out, kind, trusted_modules(named.get("trust")))
    print(f"written  {path}")
