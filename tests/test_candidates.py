"""Candidates: their command lines, their results and failures, and the result of the start."""

from __future__ import annotations

import json
import shlex
import signal
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from rounds import BASE, QUIET, candidate, write_json
from small import small_trainer

from pirl_rl.commands.baseline import measure
from pirl_rl.commands.composition import compose
from pirl_rl.continuation import start_from
from pirl_rl.errors import ConfigError
from pirl_rl.outer_loop.candidates import Task, make_job, quoted, read_result, settle, training_overrides
from pirl_rl.outer_loop.history import Result
from pirl_rl.outer_loop.plan import Candidate
from pirl_rl.run_directory import RunDirectory
from pirl_rl.schedules import LossSchedule


def make_task(folder: Path, one: Candidate | None = None, start: Result = BASE) -> Task:
    return Task("001/a", folder / "a", one or candidate(), start, Path("/b c/it's, [x]/last.pt"), 100)


def test_command_composes_to_the_plan(tmp_path):
    task = make_task(tmp_path, candidate(collocation_jitter=0.05))
    config = compose("train", ["+experiment=drift", "seed=9", *training_overrides(task, ["success"], 7)])
    assert config.schedule._target_ == "pirl_rl.schedules.LossSchedule"
    assert (config.schedule.initial, config.schedule.final) == ([1.0, 0.1, 1.0], [1.0, 0.2, 2.0])
    assert (config.schedule.center, config.schedule.steepness) == (50.0, 0.1)
    assert (config.collocation.jitter, config.collocation.replay_share) == ([0.03, 0.05], [0.9, 0.9])
    assert (config.start, config.seed, config.trainer.updates) == (str(task.path), 7, 100)
    assert (config.stages, config.evaluation.final) == ([], ["success"])


@pytest.mark.parametrize("text", ["", "my_agent {prompt} {plan}", 'it\'s, [x] = "y"', r"a\b\'c' \\'", "\\", "end\\\\"])
def test_any_text_can_be_quoted(text):
    parsed = OverridesParser.create().parse_override(f"key={quoted(text)}")
    assert parsed.value() == text


def test_command_as_typed_by_hand_is_in_the_log(tmp_path):
    one = make_job(make_task(tmp_path), ["seed=3"], [])
    [line] = one.log.read_text().splitlines()
    assert shlex.split(line.removeprefix("$ ")) == list(one.command)
    assert one.command[-1] == f"hydra.run.dir={quoted(tmp_path / 'a')}"


def test_a_part_without_checkpoint_is_removed_and_links_are_not_followed(tmp_path):
    task = make_task(tmp_path / "candidates")
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "mine").touch()
    task.folder.mkdir(parents=True)
    (task.folder / "metrics.csv").touch()
    make_job(task, [], [])
    assert not task.folder.exists()
    task.folder.symlink_to(precious)
    with pytest.raises(ConfigError, match="link"):
        make_job(task, [], [])
    task.folder.unlink()
    task.folder.mkdir()
    (task.folder / "figures").symlink_to(precious)
    with pytest.raises(ConfigError, match="leads out"):
        make_job(task, [], [])
    assert (precious / "mine").exists()


def test_weights_in_force_at_the_end(tmp_path):
    task = make_task(tmp_path, candidate(schedule_center=99.0, collocation_jitter=0.05))
    task.folder.mkdir()
    write_json(task.folder / "summary.json", {"updates": 100, "wall_seconds": 3.0, **QUIET, "td_loss": float("nan")})
    done = read_result(task)
    assert (done.status, done.checkpoint, done.updates, done.metrics) == ("done", "001/a", 100, QUIET)
    schedule = LossSchedule((1.0, 0.1, 1.0), (1.0, 0.2, 2.0), 99.0, 0.1)
    assert done.weights == schedule(99, 100) == (1.0, 0.15000000000000002, 1.5)
    assert (done.collocation_jitter, done.collocation_replay_share) == (pytest.approx(0.04), 0.9)
    summary = {"updates": 60, "collapsed_at": 60, "rolled_back_to": 30, **QUIET}
    write_json(task.folder / "summary.json", summary)
    back = read_result(task)
    assert (back.status, back.checkpoint, back.updates) == ("collapsed", "001/a", 30)
    assert back.weights == task.schedule(29, 100)
    write_json(task.folder / "summary.json", {**summary, "rolled_back_to": 0})
    back = read_result(task)
    assert (back.updates, back.weights, back.collocation_jitter) == (0, BASE.weights, 0.03)
    write_json(task.folder / "summary.json", {"updates": 100, **QUIET, "reward": float("nan")})
    assert (read_result(task).status, read_result(task).checkpoint) == ("failed", None)
    assert "reward: expected a finite number, got nan" in read_result(task).reason


def test_failure_is_told_without_paths(tmp_path):
    task = make_task(tmp_path)
    task.log.write_text("much\nerror: /home/me/x.pt does not fit\n")
    settle(task, 1)
    assert json.loads((task.folder / "failed.json").read_text())["log"][-1] == "error: /home/me/x.pt does not fit"
    failed = read_result(task)
    assert failed.reason == "exit code 1: error: <path> does not fit"
    assert (failed.status, failed.checkpoint, failed.updates) == ("failed", None, 0)


@pytest.mark.parametrize("code", [130, -signal.SIGTERM])
def test_who_is_stopped_has_not_failed(code, tmp_path):
    task = make_task(tmp_path)
    task.log.touch()
    with pytest.raises(KeyboardInterrupt):
        settle(task, code)
    assert not task.ended


def test_weights_of_the_start_are_those_of_its_last_update(tmp_path):
    schedule = "{share: 5, schedule: {_target_: pirl_rl.schedules.LinearSchedule, initial: [1, 0, 1], final: [1, 1, 3]"
    visited = "{_target_: pirl_rl.sampling.collocation.ReplayCollocation, jitter: [0.1, 0.2], replay_share: [1, 0.5]}"
    stages = f"stages=[{{share: 5}}, {schedule}, start: 0, end: 5}}, collocation: {visited}}}]"
    trainer = small_trainer(tmp_path / "before", stages, "trainer.updates=10", "evaluation.final=[success,calibration]")
    trainer.train()
    collocation = "collocation._target_=pirl_rl.sampling.collocation.ReplayCollocation"
    candidates = small_trainer(tmp_path / "next", collocation, "evaluation.final=[success,calibration]")
    path = start_from(candidates, str(tmp_path / "before"))
    begun = measure(candidates, path)
    assert begun.weights == pytest.approx((1, 0.8, 2.6))
    assert (begun.collocation_jitter, begun.collocation_replay_share) == (pytest.approx(0.18), pytest.approx(0.6))
    assert {"reward", "calibration_mae", "success_low"} <= begun.metrics.keys()
    early = start_from(candidates, str(RunDirectory.of_checkpoint(path).weights(5)))
    assert measure(candidates, early).weights == trainer.curriculum.weights(4)
    plain = small_trainer(tmp_path / "plain", "evaluation.final=[success,calibration]")
    begun = measure(plain, start_from(plain, str(path)))
    assert (begun.collocation_jitter, begun.collocation_replay_share) == (None, None)
