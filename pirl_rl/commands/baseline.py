"""The baseline of an outer loop: the checkpoint from which it starts, evaluated like each of its candidates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pirl_rl import checkpoint
from pirl_rl.assembly import make_trainer
from pirl_rl.configuration import load_config
from pirl_rl.errors import ConfigError
from pirl_rl.evaluation import evaluate, metrics_of
from pirl_rl.outer_loop.candidates import JUDGED
from pirl_rl.outer_loop.history import Result
from pirl_rl.outer_loop.plan import START
from pirl_rl.run_directory import RunDirectory
from pirl_rl.sampling.collocation import ReplayCollocation
from pirl_rl.trainer import Trainer


def measure(trainer: Trainer, path: Path, trust: Sequence[str] = ()) -> Result:
    """Evaluate the start of a loop.

    Args:
        trainer: the trainer of a candidate, with the networks of the start.
        path: checkpoint of the start, in its run directory.
        trust: modules outside the package that the start's configuration may name.

    Raises:
        ConfigError: if the start's configuration cannot be built, its reward or calibration is not finite, or it ended
            with settings that no plan can have.
    """
    measured = metrics_of(evaluate(trainer.solution, trainer.simulator, trainer.final))
    metrics = {name: value for name, value in measured.items() if math.isfinite(value)}
    if missing := [name for name in JUDGED if name not in metrics]:
        raise ConfigError(f"start: expected finite {', '.join(missing)} to compare candidates with, got none of {path}")
    try:
        return Result(checkpoint=START, metrics=metrics, **_in_force(path, trainer, trust))
    except ValidationError as error:
        raise ConfigError(f"start: {path} ended with settings that no plan has: {error.errors()[0]['msg']}") from None


def _in_force(path: Path, trainer: Trainer, trust: Sequence[str]) -> dict[str, Any]:
    """Loss weights and collocation settings at the last update of the start, from the configuration of its run.

    If the collocation of the candidates has no jitter and replay share, there are no such settings. If only that of the
    start has none, the initial values of the candidates' collocation are taken.
    """
    config = load_config(RunDirectory.of_checkpoint(path).path)
    config.device = "cpu"
    before = make_trainer(config, None, trust)
    last = max(_update(checkpoint.load(path)) - 1, 0)
    settings: dict[str, Any] = {"weights": before.curriculum.weights(last)}
    if isinstance(trainer.batches.collocation, ReplayCollocation):
        own = before.curriculum.stage(last).collocation or before.batches.collocation
        ends, progress = trainer.batches.collocation, 0.0
        if isinstance(own, ReplayCollocation):
            ends, progress = own, before.curriculum.progress(last)
        for name in ("jitter", "replay_share"):
            first, final = getattr(ends, name)
            settings[f"collocation_{name}"] = first + (final - first) * progress
    return settings


def _update(state: Mapping[str, Any]) -> int:
    """The number of updates of the networks in a checkpoint, which after a collapse are those of an earlier update."""
    rollback = state.get("rollback") or {}
    return rollback["good_at"] if rollback.get("collapsed_at") is not None else state["update"]
