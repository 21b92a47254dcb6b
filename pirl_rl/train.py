"""Train: `python -m pirl_rl.train +experiment=reach1d [method=...] [key=value ...]`, or `resume=RUN_DIR`."""

from __future__ import annotations

import contextlib
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException, HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl import checkpoint
from pirl_rl.assembly import make_trainer, restore
from pirl_rl.checkpoint import CheckpointError
from pirl_rl.collectors import CollectorError
from pirl_rl.configuration import CONF, ConfigError, load_config, save_config
from pirl_rl.evaluation import METRICS
from pirl_rl.learner import DivergenceError
from pirl_rl.loggers import METRICS_FILE
from pirl_rl.plots import draw_run
from pirl_rl.problem import ProblemError
from pirl_rl.trainer import Interrupted, Trainer

EXPECTED = (
    ConfigError,
    CheckpointError,
    CollectorError,
    DivergenceError,
    ProblemError,
    HydraException,
    OmegaConfBaseException,
)
"""Errors that are the user's to mend: their message is enough."""

INTERRUPTED = 130


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def train(config: DictConfig) -> float:
    """A new run in Hydra's run directory; returns the metric that a sweep may minimise."""
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    with _told(folder, one_of_many=hydra_config.mode == RunMode.MULTIRUN), _new(folder):
        # What the user types is trusted; what a directory from elsewhere says is not.
        trust = [*config.trust, *_named_modules(hydra_config.overrides.task)]
        trainer = make_trainer(config, folder, trust)
        save_config(config, folder)
        OmegaConf.save(hydra_config.overrides.task, folder / ".hydra" / "overrides.yaml")
        summary = _train(trainer)
    return summary.get("value_mse", summary.get("hjb_sup_loss", float("nan")))


def resume(folder: Path, overrides: Sequence[str]) -> None:
    """Go on in a run directory, with plain `key=value` overrides of its configuration, which keeps them."""
    with _told(folder):
        config = load_config(folder)
        _refuse_links(folder)
        config.trust = []
        for override in overrides:
            _override(config, override)
        trainer = make_trainer(config, folder, [*config.trust, *_named_modules(overrides)])
        restore(trainer)
        save_config(config, folder)
        _train(trainer)


def _train(trainer: Trainer) -> dict[str, float]:
    summary = trainer.train()
    folder = trainer.folder
    assert folder is not None
    print(_table(summary))
    for figure in draw_run(trainer.solution, folder / METRICS_FILE, folder / "figures"):
        print(f"figure   {figure}")
    print(f"run      {folder}")
    return summary


def _table(summary: dict[str, float]) -> str:
    rows = [
        f"{name:<20} {value:>12.5g}   {textwrap.shorten(METRICS.get(name, ''), 84, placeholder=' ...')}"
        for name, value in summary.items()
    ]
    return "\n".join(["", f"{'metric':<20} {'value':>12}   meaning", "-" * 120, *rows, ""])


def _named_modules(overrides: Sequence[str]) -> list[str]:
    """The modules of the `_target_`s that were typed."""
    targets = [value for key, _, value in (item.partition("=") for item in overrides) if key.endswith("_target_")]
    return [target.partition(".")[0] for target in targets]


def _override(config: DictConfig, text: str) -> None:
    try:
        override = OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise ConfigError(f"{text}: {error}") from None
    plain = "=" in text and not text.startswith(("+", "~")) and not override.is_sweep_override()
    if not plain or isinstance(OmegaConf.select(config, override.key_or_group), DictConfig):
        raise ConfigError(f"{text}: a resumed run takes key=value of single settings only")
    OmegaConf.update(config, override.key_or_group, override.value())


def _refuse_links(folder: Path) -> None:
    """A foreign run directory is not to make us write elsewhere."""
    for path in folder.rglob("*"):
        if path.is_symlink() and not path.resolve().is_relative_to(folder.resolve()):
            raise ConfigError(f"{path} leads out of the run directory, to {path.resolve()}")


@contextlib.contextmanager
def _new(folder: Path) -> Iterator[None]:
    """Nothing is overwritten, and a run that ends before its first row or checkpoint leaves nothing behind."""
    if any(folder.iterdir()):
        raise ConfigError(f"hydra.run.dir: {folder} is not empty, and a run never overwrites anything")
    try:
        yield
    except BaseException:
        if not (folder / METRICS_FILE).exists() and not (folder / checkpoint.FOLDER).exists():
            shutil.rmtree(folder)
            for parent in (folder.parent, folder.parent.parent):
                with contextlib.suppress(OSError):
                    parent.rmdir()  # empty ones only
        raise


@contextlib.contextmanager
def _told(folder: Path, one_of_many: bool = False) -> Iterator[None]:
    """Expected errors end as one message and an exit code; in a sweep the other jobs still run."""
    try:
        yield
    except Interrupted as stop:
        print(f"{stop}; go on with: python -m pirl_rl.train resume={folder}", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except EXPECTED as error:
        message = f"error: {_one_line(error)}"
        print(message, file=sys.stderr, flush=True)
        if one_of_many:
            raise CompactHydraException(message) from None
        raise SystemExit(1) from None


def _one_line(error: Exception) -> str:
    if isinstance(error, OmegaConfBaseException):
        return f"{error.full_key}: {str(error.msg).partition(chr(10))[0]}"
    return str(error)


def main() -> None:
    arguments = sys.argv[1:]
    resumed = [item for item in arguments if item.startswith("resume=") and item != "resume=null"]
    try:
        if resumed:
            folder = Path(resumed[-1].partition("=")[2])
            resume(folder, [item for item in arguments if item not in resumed])
        else:
            train()
    except KeyboardInterrupt:
        print("stopped at once; what the last checkpoint holds is kept", file=sys.stderr)
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
