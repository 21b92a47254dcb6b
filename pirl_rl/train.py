"""Train: `python -m pirl_rl.train +experiment=reach1d [method=...] [key=value ...]`, or `resume=RUN_DIR`."""

from __future__ import annotations

import contextlib
import shutil
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl import checkpoint
from pirl_rl.checkpoint import CheckpointError
from pirl_rl.collectors import CollectorError
from pirl_rl.configuration import CONF, ConfigError, load_config
from pirl_rl.evaluation import METRICS
from pirl_rl.learner import DivergenceError
from pirl_rl.loggers import METRICS_FILE
from pirl_rl.plots import draw_run
from pirl_rl.runs import make_trainer
from pirl_rl.trainer import Interrupted, Trainer

EXPECTED = (ConfigError, CheckpointError, CollectorError, DivergenceError, OmegaConfBaseException)
"""Errors that are the user's to mend: their message is enough."""


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def train(config: DictConfig) -> float:
    """A new run in Hydra's run directory; returns the metric that a sweep may minimise."""
    hydra_config = HydraConfig.get()
    folder = Path(hydra_config.runtime.output_dir)
    # What the user types is trusted; what a directory from elsewhere says is not.
    typed = [item.partition("=")[2].split(".")[0] for item in hydra_config.overrides.task if "_target_=" in item]
    with _told(folder):
        if (folder / METRICS_FILE).exists():
            raise ConfigError(f"{folder} holds a run already; it is never overwritten")
        trainer = make_trainer(config, folder, [*config.trust, *typed])
        summary = _train(trainer)
    return summary.get("value_mse", summary.get("hjb_sup_loss", float("nan")))


def resume(folder: Path, overrides: list[str]) -> None:
    """Go on in a run directory, with plain `key=value` overrides of its configuration."""
    with _told(None):
        config = load_config(folder)
        for override in overrides:
            key, equals, value = override.partition("=")
            if not equals or key.startswith(("+", "~", "-")):
                raise ConfigError(f"resume takes key=value overrides only, got {override!r}")
            OmegaConf.update(config, key, OmegaConf.create(f"value: {value}").value)
        trainer = make_trainer(config, folder, config.trust)
        trainer.load_state_dict(checkpoint.load(folder / "checkpoints" / checkpoint.LAST, trainer.solution.device))
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
    rows = [f"{name:<20} {value:>12.5g}   {METRICS.get(name, '')[:96]}" for name, value in summary.items()]
    return "\n".join(["", f"{'metric':<20} {'value':>12}   meaning", "-" * 80, *rows, ""])


@contextlib.contextmanager
def _told(folder: Path | None):
    """Expected errors end as one message and an exit code; a new run that never trained leaves nothing behind."""
    try:
        yield
    except Interrupted as stop:
        print(f"{stop}; go on with: python -m pirl_rl.train resume={folder or 'RUN_DIR'}", file=sys.stderr)
        raise SystemExit(130) from None
    except EXPECTED as error:
        if folder is not None and not (folder / METRICS_FILE).exists():
            _remove(folder)
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    for parent in (folder.parent, folder.parent.parent):
        with contextlib.suppress(OSError):
            parent.rmdir()  # empty ones only


def main() -> None:
    resumed = [item for item in sys.argv[1:] if item.startswith("resume=") and item != "resume=null"]
    if resumed:
        resume(Path(resumed[-1].partition("=")[2]), [item for item in sys.argv[1:] if item not in resumed])
    else:
        train()


if __name__ == "__main__":
    main()
