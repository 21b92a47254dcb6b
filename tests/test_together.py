"""Commands that are trained side by side in one process leave the runs that they would leave alone."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from small import EVENTS, QUICK, TUNED, at_update, command, interrupt

from pirl_rl.commands import together
from pirl_rl.commands.together import train_together
from pirl_rl.commands.train import resume
from pirl_rl.errors import Interrupted
from pirl_rl.outer_loop.processes import Job
from pirl_rl.outer_loop.together import Together
from pirl_rl.run_directory import RunDirectory

SETTINGS = {"a": ("schedule.center=0.2", "seed=1"), "b": ("schedule.center=0.7", "seed=2")}


def commands(folder: Path, *more: str, **settings: tuple[str, ...]) -> list[dict]:
    """Commands with the runs `folder`/name; lines in their logs come before."""
    folder.mkdir(exist_ok=True)
    made = []
    for name, own in (settings or SETTINGS).items():
        arguments = [*QUICK, *EVENTS, "evaluation.during=[]", *own, *more, f"hydra.run.dir='{folder / name}'"]
        made.append({"arguments": arguments, "log": str(folder / f"{name}.log")})
        Path(made[-1]["log"]).write_text("$ the command\n")
    return made


def assert_equal(one: Path, other: Path) -> None:
    """Equal configurations and, up to rounding in double precision, equal metrics."""
    left, right = RunDirectory(one), RunDirectory(other)
    assert left.overrides.read_text() == right.overrides.read_text()
    assert left.config.read_text() == right.config.read_text()
    rows = [list(csv.DictReader(run.metrics.open())) for run in (left, right)]
    assert len(rows[0]) == len(rows[1])
    for a, b in zip(*rows, strict=True):
        assert a.keys() == b.keys()
        numbers = [[float(row[name] or "nan") for name in a if name != "wall_seconds"] for row in (a, b)]
        assert numbers[0] == pytest.approx(numbers[1], rel=1e-6, nan_ok=True)
    for name, number in left.numbers().items():
        if name not in ("wall_seconds", "updates_per_second"):
            assert right.numbers()[name] == pytest.approx(number, rel=1e-6, nan_ok=True), name


@pytest.fixture(autouse=True)
def without_figures(monkeypatch):
    """Runs without figures, which take longer than the trainings."""
    monkeypatch.setattr(together, "show", lambda trainer, *_: print(f"run      {trainer.folder}"))


@pytest.mark.usefixtures("float64")
def test_each_command_leaves_its_own_run(tmp_path):
    for name in SETTINGS:
        train_together(commands(tmp_path / "alone", **{name: SETTINGS[name]}))
    train_together(commands(tmp_path / "side by side"))
    for name in SETTINGS:
        assert_equal(tmp_path / "alone" / name, tmp_path / "side by side" / name)
        log = (tmp_path / "side by side" / f"{name}.log").read_text()
        assert log.startswith("$ the command\n")
        assert f"run      {tmp_path / 'side by side' / name}" in log


def test_what_cannot_be_trained_says_so_in_its_log(tmp_path):
    settings = {"good": (), "bad": ("loss.td_criterion=cubes",), "wild": ("learner.learning_rate=1e30",)}
    train_together(commands(tmp_path / "out", **settings))
    runs = {name: RunDirectory(tmp_path / "out" / name) for name in settings}
    assert [name for name, run in runs.items() if run.summary.exists()] == ["good"]
    assert not runs["bad"].path.exists()
    last = {name: (tmp_path / "out" / f"{name}.log").read_text().splitlines()[-1] for name in settings}
    assert last["bad"].startswith("error: loss.td_criterion: expected")
    assert last["wild"].startswith("error: update ")


@pytest.mark.usefixtures("float64")
def test_interrupted_commands_go_on_as_if_nothing_had_happened(tmp_path, monkeypatch):
    train_together(commands(tmp_path / "whole"))
    begun, begin = commands(tmp_path / "begun"), together.begin

    def begin_and_stop(*arguments):
        trainer = begin(*arguments)
        if trainer.folder.name == "a":
            at_update(trainer, 7, interrupt)
        return trainer

    with monkeypatch.context() as patched:
        patched.setattr(together, "begin", begin_and_stop)
        with pytest.raises(Interrupted):
            train_together(begun)
    resumed = [
        one | {"arguments": [f"resume={tmp_path / 'begun' / name}"]} for name, one in zip("ab", begun, strict=True)
    ]
    train_together(resumed)
    for name in SETTINGS:
        one, other = (RunDirectory(tmp_path / folder / name).numbers() for folder in ("whole", "begun"))
        assert other["value_mse"] == pytest.approx(one["value_mse"], rel=1e-6)
    with pytest.raises(SystemExit):
        resume(tmp_path / "begun" / "a", ["start=elsewhere"])


class Failing:
    """In place of a process: it writes a line and ends with a code."""

    def __init__(self, code: int):
        self.code, self.jobs = code, []

    def run(self, jobs, ended):
        self.jobs += jobs
        for job in jobs:
            job.log.write_text("error: no memory\n")
            ended(job, self.code)


@pytest.mark.parametrize("code", [0, 1, 130, -9])
def test_one_process_has_all_jobs(code, tmp_path):
    """The log of each job has the reason of a process that fails. A code of 0 is no success of a single job."""
    jobs = [Job(name, ("python", "-m", "pirl_rl.train", f"x={name}"), tmp_path / f"{name}.log") for name in "ab"]
    processes, codes = Failing(code), {}
    Together(processes).run(jobs, lambda job, own: codes.update({job.name: own}))  # type: ignore[arg-type]
    assert codes == {"a": code or 1, "b": code or 1}
    [one] = processes.jobs
    listed = [json.loads(text) for text in one.command[3:]]
    assert listed == [{"arguments": [f"x={name}"], "log": str(tmp_path / f"{name}.log")} for name in "ab"]
    assert [("no memory" in job.log.read_text()) for job in jobs] == [code != 0] * 2
    Together(processes).run([], lambda job, own: codes.clear())  # type: ignore[arg-type]
    assert codes


@pytest.mark.slow
def test_a_loop_with_populations_decides_as_one_with_processes(trained, tmp_path):
    line = [*TUNED, f"start={trained}", "updates=40", "rounds=2", "candidates=2"]
    for name, own in (("processes", ()), ("population", ("population=true",))):
        done = command(*line, *own, f"out={name}", cwd=tmp_path, module="pirl_rl.tune")
        assert done.returncode == 0, done.stderr
    first, second = (sorted((tmp_path / name).rglob("plan.json")) for name in ("processes", "population"))
    assert [path.read_text() for path in first] == [path.read_text() for path in second]
    first, second = (
        sorted((tmp_path / name).rglob("candidates/*/summary.json")) for name in ("processes", "population")
    )
    assert len(first) == len(second) == 4
    for one, other in zip(first, second, strict=True):
        values = [json.loads(path.read_text())["td_loss"] for path in (one, other)]
        assert values[0] == pytest.approx(values[1], rel=1e-3)
