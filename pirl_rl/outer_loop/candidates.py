"""Candidates: their command lines, what has become of them, and what comes of them."""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pirl_rl.errors import INTERRUPTED, ConfigError
from pirl_rl.files import replacing
from pirl_rl.outer_loop.history import Result
from pirl_rl.outer_loop.plan import Candidate
from pirl_rl.outer_loop.processes import Job
from pirl_rl.outer_loop.redaction import redact
from pirl_rl.run_directory import RunDirectory
from pirl_rl.schedules import LossSchedule

FAILED = "failed.json"
"""Beside a run's own files: the exit code and the last lines of a candidate that ended with an error."""

JUDGED = ("reward", "calibration_mae")
"""Metrics that every result must have."""

TIMES = ("updates", "wall_seconds", "updates_per_second")
"""Entries of a summary that are no metrics: they differ when the same candidate is trained again."""

STOPPED = (INTERRUPTED, *(-number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)))
"""Exit codes of a candidate that was asked to stop and can go on."""

LEADING = ("trainer.rollback=true",)
"""Settings of a candidate's training that stand before the user's own, which may change them."""

LAST_LINES = 20


@dataclass(frozen=True)
class Task:
    """A candidate in its place.

    Attributes:
        name: "<round>/<candidate>".
        folder: its run directory; the log lies beside it, as a new run directory must be empty.
        candidate: its entry in the plan.
        start: the result from which it goes on; its run or checkpoint lies at `path`.
        updates: length of its training.
    """

    name: str
    folder: Path
    candidate: Candidate
    start: Result
    path: Path
    updates: int

    @property
    def log(self) -> Path:
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def run(self) -> RunDirectory:
        return RunDirectory(self.folder)

    @property
    def failure(self) -> Path:
        return self.folder / FAILED

    @property
    def ended(self) -> bool:
        return self.run.summary.is_file() or self.failure.is_file()

    @property
    def schedule(self) -> LossSchedule:
        """Of the candidate's training. A plan counts in updates, and a schedule takes a center up to 1 for a share."""
        one = self.candidate
        unit = self.updates if one.schedule_center <= 1 else 1
        center, steepness = one.schedule_center / unit, one.schedule_sharpness * unit
        return LossSchedule(one.schedule_initial, one.schedule_final, center, steepness)

    def moves(self) -> dict[str, tuple[float, float]]:
        """Start and end of what moves along the schedule, by its key in `collocation`; none where that has no such."""
        pairs = {}
        for key, name in (("jitter", "collocation_jitter"), ("replay_share", "collocation_replay_share")):
            before, after = getattr(self.start, name), getattr(self.candidate, name)
            if before is not None:
                pairs[key] = (before, before if after is None else after)
        return pairs


def overrides(task: Task, final: Sequence[str], seed: int) -> list[str]:
    """The settings of a candidate's training that are not the user's."""
    one = task.candidate
    return [
        f"evaluation.final=[{','.join(final)}]",
        f"start={quoted(task.path)}",
        "schedule=sigmoid",
        f"schedule.initial={_list(one.schedule_initial)}",
        f"schedule.final={_list(one.schedule_final)}",
        f"schedule.center={task.schedule.center!r}",
        f"schedule.steepness={task.schedule.steepness!r}",
        *(f"++collocation.{key}={_list(ends)}" for key, ends in task.moves().items()),
        "stages=[]",
        f"trainer.updates={task.updates}",
        f"seed={seed}",
    ]


def job(task: Task, settings: Sequence[str], trust: Sequence[str]) -> Job:
    """The command line that begins a candidate, or goes on with what there is of it; says so in the log.

    Args:
        task: one that has not ended.
        settings: all overrides of a new run.
        trust: modules outside the package; one that goes on names them again.
    """
    train = [sys.executable, "-m", "pirl_rl.train"]
    if task.run.last.is_file():
        command = [*train, f"resume={task.folder}", f"trust=[{','.join(trust)}]"]
    else:
        _clear(task.folder)
        command = [*train, *settings, f"hydra.run.dir={quoted(task.folder)}"]
    task.log.parent.mkdir(parents=True, exist_ok=True)
    with task.log.open("a", encoding="utf-8") as log:
        log.write(f"$ {redact(shlex.join(command))}\n")
    return Job(task.name, tuple(command), task.log)


def _clear(folder: Path) -> None:
    """Remove a run that has no checkpoint to go on from."""
    if folder.is_symlink():
        raise ConfigError(f"{folder}: expected a run directory, got a link")
    if folder.exists():
        RunDirectory(folder).refuse_links()
        shutil.rmtree(folder)


def settle(task: Task, code: int) -> None:
    """Take note of a process's end.

    Raises:
        KeyboardInterrupt: somebody stopped it, which is nobody's failure.
    """
    text = task.log.read_text(encoding="utf-8", errors="replace")
    if (clean := redact(text)) != text:
        with replacing(task.log) as file:
            file.write(clean)
    if task.run.summary.is_file():
        return
    if code in STOPPED:
        raise KeyboardInterrupt(f"{task.name} was stopped")
    lines = [line for line in clean.splitlines() if line.strip()]
    with replacing(task.failure) as file:
        json.dump({"exit_code": code, "log": lines[-LAST_LINES:]}, file, indent=2)


def result(task: Task) -> Result:
    """What became of a candidate that has ended."""
    if not task.run.summary.is_file():
        failure = json.loads(task.failure.read_text(encoding="utf-8"))
        last = failure["log"][-1] if failure["log"] else "no word"
        # Later prompts quote it, and no path is to enter a prompt.
        reason = re.sub(r"\S*/\S*", "<path>", last)[:300]
        return _result(task, task.updates, status="failed", reason=f"exit code {failure['exit_code']}: {reason}")
    summary = json.loads(task.run.summary.read_text(encoding="utf-8"))
    metrics = {name: value for name, value in summary.items() if name not in TIMES and math.isfinite(value)}
    if missing := [name for name in JUDGED if name not in metrics]:
        reason = f"{', '.join(missing)}: expected a finite number, got {summary.get(missing[0])}"
        return _result(task, task.updates, status="failed", reason=reason)
    if "collapsed_at" in summary:
        kept = int(summary["rolled_back_to"])
        reason = f"collapsed at update {summary['collapsed_at']}, rolled back to update {kept}"
        return _result(task, kept, checkpoint=task.name, status="collapsed", metrics=metrics, reason=reason)
    return _result(task, int(summary["updates"]), checkpoint=task.name, metrics=metrics)


def _result(task: Task, updates: int, checkpoint: str | None = None, **rest) -> Result:
    """With what is in force at the last of its updates."""
    weights, ends = task.start.weights, {key: before for key, (before, _) in task.moves().items()}
    if updates > 0:
        progress = task.schedule.progress(updates - 1, task.updates)
        weights = task.schedule(updates - 1, task.updates)
        ends = {key: before + (after - before) * progress for key, (before, after) in task.moves().items()}
    return Result(
        checkpoint=checkpoint,
        candidate=task.candidate,
        updates=task.start.updates + (0 if rest.get("status") == "failed" else updates),
        weights=weights,
        collocation_jitter=ends.get("jitter"),
        collocation_replay_share=ends.get("replay_share"),
        **rest,
    )


def quoted(text: Path | str) -> str:
    """A path or text as a value of Hydra's command line, whatever characters it has."""
    backslashes = re.sub(r"(\\+)(?='|\Z)", r"\1\1", str(text))  # elsewhere they stand for themselves
    return "'" + backslashes.replace("'", "\\'") + "'"


def _list(values: Sequence[float]) -> str:
    return f"[{','.join(repr(float(value)) for value in values)}]"
