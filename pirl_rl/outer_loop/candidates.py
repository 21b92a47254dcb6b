"""Candidates of an outer loop: their command lines, their failures and their results."""

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
"""The file in a run directory with the exit code and the last lines of a candidate that ended with an error."""

JUDGED = ("reward", "calibration_mae")
"""Metrics that every result must have."""

TIMES = ("updates", "wall_seconds", "updates_per_second")
"""Entries of a summary that are not metrics; the times differ when the same candidate is trained again."""

# Not every system has all of these signals.
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

STOPPED = (INTERRUPTED, *(-number for number in SIGNALS))
"""Exit codes of a candidate that was asked to stop and can be resumed."""

LEADING = ("trainer.rollback=true",)
"""Settings of a candidate's training that precede the user's, so that the user can change them."""

LAST_LINES = 20
"""Number of lines of a failed candidate's log that are recorded."""


@dataclass(frozen=True)
class Task:
    """The training of a candidate.

    Attributes:
        name: "<round>/<candidate>".
        folder: its run directory; the log lies beside it, because a new run directory must be empty.
        candidate: its entry in the plan.
        start: the result from which it continues.
        path: the run directory or the checkpoint of `start`.
        updates: number of updates of its training.
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
        """The schedule of the loss weights, Eq. (weight_scheduling).

        A plan counts in updates, but `LossSchedule` takes a center up to 1 as a share of the training.
        """
        plan = self.candidate
        unit = self.updates if plan.schedule_center <= 1 else 1
        center, steepness = plan.schedule_center / unit, plan.schedule_sharpness * unit
        return LossSchedule(plan.schedule_initial, plan.schedule_final, center, steepness)

    def collocation_ends(self) -> dict[str, tuple[float, float]]:
        """Initial and final value of the collocation settings that follow the schedule, by their key in `collocation`.

        It is empty if the collocation has no such settings.
        """
        pairs = {}
        for key, name in (("jitter", "collocation_jitter"), ("replay_share", "collocation_replay_share")):
            before, after = getattr(self.start, name), getattr(self.candidate, name)
            if before is not None:
                pairs[key] = (before, before if after is None else after)
        return pairs


def training_overrides(task: Task, final: Sequence[str], seed: int) -> list[str]:
    """The overrides of a candidate's training that the loop adds to the user's.

    Args:
        task: the candidate.
        final: names of the evaluators that judge it.
        seed: seed of its training.
    """
    plan = task.candidate
    return [
        f"evaluation.final=[{','.join(final)}]",
        f"start={quoted(task.path)}",
        "schedule=sigmoid",
        f"schedule.initial={_list(plan.schedule_initial)}",
        f"schedule.final={_list(plan.schedule_final)}",
        f"schedule.center={task.schedule.center!r}",
        f"schedule.steepness={task.schedule.steepness!r}",
        *(f"++collocation.{key}={_list(ends)}" for key, ends in task.collocation_ends().items()),
        "stages=[]",
        f"trainer.updates={task.updates}",
        f"seed={seed}",
    ]


def make_job(task: Task, settings: Sequence[str], trust: Sequence[str]) -> Job:
    """The command line that starts or resumes the training of a candidate; it is written to the log too.

    Args:
        task: a candidate that has not ended.
        settings: all overrides of a new run.
        trust: modules outside the package, which a resumed run has to name again.
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
    """Remove the directory of a run that has no checkpoint and cannot be resumed."""
    if folder.is_symlink():
        raise ConfigError(f"{folder}: expected a run directory, got a link")
    if folder.exists():
        RunDirectory(folder).refuse_links()
        shutil.rmtree(folder)


def settle(task: Task, code: int) -> None:
    """Record the end of a candidate's process, and remove secrets from its log.

    Args:
        task: the candidate.
        code: exit code of the process.

    Raises:
        KeyboardInterrupt: if the process was stopped, which does not count as a failure.
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


def read_result(task: Task) -> Result:
    """Read the result of a candidate that has ended from its run directory."""
    if not task.run.summary.is_file():
        failure = json.loads(task.failure.read_text(encoding="utf-8"))
        last = failure["log"][-1] if failure["log"] else "no output"
        # Later prompts quote the reason, and paths of this machine do not belong into a prompt.
        reason = re.sub(r"\S*/\S*", "<path>", last)[:300]
        return _result(task, task.updates, status="failed", reason=f"exit code {failure['exit_code']}: {reason}")
    summary = task.run.numbers()
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
    """A result with the loss weights and collocation settings in force at the last of `updates` updates."""
    weights, ends = task.start.weights, {key: before for key, (before, _) in task.collocation_ends().items()}
    if updates > 0:
        progress = task.schedule.progress(updates - 1, task.updates)
        weights = task.schedule(updates - 1, task.updates)
        ends = {key: before + (after - before) * progress for key, (before, after) in task.collocation_ends().items()}
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
    """Quote a path or text with any characters as a value of Hydra's command line."""
    # Hydra unescapes backslashes only before a quote.
    doubled = re.sub(r"(\\+)(?='|\Z)", r"\1\1", str(text))
    return "'" + doubled.replace("'", "\\'") + "'"


def _list(values: Sequence[float]) -> str:
    return f"[{','.join(repr(float(value)) for value in values)}]"
