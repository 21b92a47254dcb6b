"""The outer loop: what it asks, runs, keeps and survives."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from small import command, small_trainer

import pirl_rl.files
from pirl_rl import tune
from pirl_rl.configuration import CONF, ConfigError, load_config
from pirl_rl.outer_loop.advisors import AdvisorError
from pirl_rl.outer_loop.advisors.greedy import Greedy
from pirl_rl.outer_loop.candidates import Task, job, overrides, quoted, result, settle
from pirl_rl.outer_loop.directory import LOCK, locked
from pirl_rl.outer_loop.loop import Loop, Settings
from pirl_rl.outer_loop.plan import Candidate, Plan, Result
from pirl_rl.outer_loop.processes import Job, Processes
from pirl_rl.outer_loop.record import Record
from pirl_rl.outer_loop.report import markdown, write_report
from pirl_rl.outer_loop.start import measure
from pirl_rl.outer_loop.tree import best_path
from pirl_rl.schedules import LossSchedule

BASE = Result(
    checkpoint="start",
    weights=(1.0, 0.1, 1.0),
    collocation_jitter=0.03,
    collocation_replay_share=0.9,
    metrics={"reward": 0.8, "success_rate": 0.8, "calibration_mae": 0.05, "success_low": 0.79, "success_high": 0.81},
)
SECRET = 'sk-"not/told'
SMALL = ("+experiment=reach1d", "+debug=default", "env.num_envs=32", "collector.frames_per_batch=64")
SMALL += ("collector.warmup_frames=64",)
QUIET = {"reward": 0.8, "calibration_mae": 0.04, "success_rate": 0.8}


class Killed(BaseException):
    """SIGKILL, as far as a test can raise it."""


class Clock:
    """Kills at the k-th of the moments that count."""

    def __init__(self, last: int = -1):
        self.moments, self.last = 0, last

    def tick(self) -> None:
        if self.moments == self.last:
            raise Killed
        self.moments += 1


class FakeTrain:
    """A launcher that trains nothing: its summaries follow from a candidate's settings alone."""

    def __init__(self, summaries=None, clock: Clock | None = None):
        self.summaries, self.clock = summaries or {}, clock or Clock()
        self.commands: list[tuple[str, ...]] = []

    def run(self, jobs, ended) -> None:
        for one in jobs:
            self.commands.append(one.command)
            ended(one, self._train(one))

    def _train(self, one: Job) -> int:
        assert one.command[:3] == (sys.executable, "-m", "pirl_rl.train")
        settings = dict(text.partition("=")[::2] for text in one.command[3:])
        folder = one.log.with_suffix("")
        self.clock.tick()
        if "resume" in settings:
            assert Path(settings["resume"]) == folder
            text = (folder / "settings").read_text()
        else:
            assert settings["hydra.run.dir"] == f"'{folder}'"
            folder.mkdir(parents=True)
            text = "\n".join(f"{name}={settings[name]}" for name in settings if name.startswith(("schedule", "++coll")))
            (folder / "settings").write_text(text)
            self.clock.tick()
            (folder / "checkpoints").mkdir()
            (folder / "checkpoints" / "last.pt").touch()
            self.clock.tick()
        summary = self.summaries.get(one.name) or {**QUIET, "calibration_mae": number(text)}
        if "exit" in summary:
            one.log.write_text(f"begun in {folder}\nerror: {summary['told']}\n")
            return summary["exit"]
        write_json(folder / "summary.json", {"updates": 100, "wall_seconds": time.time(), **summary})
        self.clock.tick()
        return 0


def number(text: str) -> float:
    """In [0.01, 0.05), the same for the same text."""
    return 0.01 + 0.04 * int(hashlib.sha256(text.encode()).hexdigest()[:6], 16) / 16**6


def write_json(path: Path, data) -> None:
    path.write_text(json.dumps(data))


class Scripted:
    """Answers in turn; the last one for ever. Exceptions are raised, callables called with the request."""

    def __init__(self, *answers):
        self.answers, self.requests = list(answers), []

    def propose(self, request):
        self.requests.append(request)
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        answer = answer(request) if callable(answer) else answer
        if isinstance(answer, BaseException):
            raise answer
        return answer


def candidate(name: str = "a", **settings) -> Candidate:
    fields = {
        "schedule_initial": (1.0, 0.1, 1.0),
        "schedule_final": (1.0, 0.2, 2.0),
        "schedule_center": 50.0,
        "schedule_sharpness": 0.1,
    }
    return Candidate(name=name, **(fields | settings))


def answer(*candidates: Candidate, note: str = "why a and b") -> str:
    return Plan(round_note=note, candidates=list(candidates or (candidate("a"), candidate("b")))).model_dump_json()


def greedy(request) -> str:
    return Greedy().propose(request)


def slow(request) -> str:
    """Learns from its errors."""
    return answer(note=f"a and b, round {request.number}") if request.errors else "no"


def make_loop(out: Path, advisor=None, launcher=None, **settings) -> Loop:
    out.mkdir(exist_ok=True)
    given = {"rounds": 2, "candidates": 2, "updates": 100, "extra_rounds": 0, "start": Path("/some where/last.pt")}
    return Loop(Settings(**given | settings), Record(out), advisor or Greedy(), launcher or FakeTrain())


def run(loop: Loop):
    return loop.run(loop.record.history(BASE, 0.01))


def tree(out: Path) -> dict[str, str]:
    """All that a loop decided and measured."""
    found = (path for path in out.rglob("*") if path.is_file() and path.suffix != ".log" and path.name != LOCK)
    kept = {str(path.relative_to(out)): path for path in found if path.suffix != ".pt"}
    return {name: _timeless(path).replace(str(out), "out") for name, path in kept.items()}


def _timeless(path: Path) -> str:
    if path.name != "summary.json":
        return path.read_text()
    return str({name: v for name, v in json.loads(path.read_text()).items() if "second" not in name})


# ---------------------------------------------------------------- rounds


@pytest.mark.parametrize(("rounds", "candidates"), [(1, 1), (3, 2), (2, 4)])
def test_exactly_what_was_asked_is_launched(rounds, candidates, tmp_path):
    launcher = FakeTrain()
    history = run(make_loop(tmp_path, launcher=launcher, rounds=rounds, candidates=candidates))
    assert [len(one.results) for one in history.rounds] == [candidates] * rounds
    assert len(launcher.commands) == len(set(launcher.commands)) == rounds * candidates
    assert len(list(tmp_path.glob("rounds/*/candidates/*/summary.json"))) == rounds * candidates
    assert run(make_loop(tmp_path, launcher=launcher, rounds=rounds, candidates=candidates)) == history
    assert len(launcher.commands) == rounds * candidates


def test_killed_anywhere_it_goes_on_to_the_same_tree(tmp_path, monkeypatch):
    advisors = {"greedy": greedy, "slow": slow, "stubborn": "no"}
    summaries = {"001/b": {"exit": 1, "told": "it exploded"}}
    write = os.replace
    for name, answers in advisors.items():
        expected, asked, moments, killed = None, None, 0, -1
        while killed < moments:
            out, advisor, clock = tmp_path / f"{name}{killed}", Scripted(answers), Clock(killed)

            def replace_at(source, target, clock=clock):
                clock.tick()
                write(source, target)
                clock.tick()

            with monkeypatch.context() as patch:
                patch.setattr(pirl_rl.files.os, "replace", replace_at)
                patch.setattr(pirl_rl.files.os, "fsync", lambda file: None)
                launcher = FakeTrain(summaries, clock)
                try:
                    run(make_loop(out, advisor, launcher))
                except Killed:
                    clock.last = -1
                    run(make_loop(out, advisor, launcher))
            if expected is None:
                expected, asked, moments = tree(out), len(advisor.requests), clock.moments
            assert tree(out) == expected, killed
            assert asked <= len(advisor.requests) <= asked + 1, killed
            killed += 1
        assert moments > 30


def test_a_finished_candidate_is_not_run_again(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(Killed):
        run(make_loop(out, launcher=FakeTrain(clock=Clock(6))))
    done = {path: path.stat().st_mtime_ns for path in out.rglob("summary.json")}
    assert len(done) == 1
    launcher = FakeTrain()
    run(make_loop(out, launcher=launcher))
    assert len(launcher.commands) == 3
    assert done == {path: path.stat().st_mtime_ns for path in done}


@pytest.mark.parametrize(
    ("improve", "extra", "rounds"),
    [([1, 1, 1, 1, 1], 2, 4), ([1, 1, 0, 1, 1], 2, 3), ([1, 0, 1], 2, 2), ([1, 1, 1], 0, 2), ([0, 1, 0, 1], 3, 3)],
)
def test_extra_rounds_only_while_they_pay(improve, extra, rounds, tmp_path):
    steps = [0.05 - 0.001 * (index + 1) if better else 0.06 for index, better in enumerate(improve)]
    names = [f"{index:03d}/a" for index in range(1, len(steps) + 1)]
    summaries = {
        name: {"reward": 0.8, "calibration_mae": mae, "success_rate": 0.8}
        for name, mae in zip(names, steps, strict=True)
    }
    advisor = Scripted(lambda request: answer(candidate("a", schedule_center=request.number), note="a again"))
    loop = make_loop(tmp_path, advisor, FakeTrain(summaries), candidates=1, rounds=2, extra_rounds=extra)
    history = run(loop)
    assert len(history.rounds) == rounds
    assert history.best.metrics["calibration_mae"] == min(steps[:rounds])


def test_best_is_no_worse_in_reward(tmp_path):
    worse, better = {**QUIET, "reward": 0.7, "calibration_mae": 0.001}, {**QUIET, "reward": 0.795}
    launcher = FakeTrain({"001/a": worse, "001/b": better})
    history = run(make_loop(tmp_path, Scripted(answer()), launcher, rounds=1))
    assert history.best.checkpoint == "001/b"
    assert best_path(history) == ["start", "001/b"]


def test_context_is_read_before_every_round(tmp_path):
    def think(request):
        (tmp_path / "context.md").write_text(f"<!-- hidden -->told in round {request.number}")
        return greedy(request)

    advisor = Scripted(think)
    run(make_loop(tmp_path, advisor))
    first, second = (request.prompt for request in advisor.requests)
    assert "told in round" not in first
    assert "told in round 1" in second
    assert "hidden" not in second
    assert (tmp_path / "rounds" / "002" / "prompt.md").read_text() == second


# ---------------------------------------------------------------- bad advice

WRONG = {
    "no JSON": "I would raise the weights.",
    "schema": '{"candidates": [1, 2]}',
    "unknown checkpoint": answer(candidate("a", start_checkpoint="009/z"), candidate("b")),
    "negative": answer().replace("0.2", "-0.2"),
    "huge": answer().replace("0.2", "1e30"),
    "infinite": answer().replace("0.2", "Infinity"),
    "NaN": answer().replace("0.2", "NaN"),
    "too many": answer(*(candidate(name) for name in "abcdefgh")),
    "too few": answer(candidate("a")),
    "same name": answer(candidate("a"), candidate("a")),
    "10 MB": answer(note="x") + " " * 10_000_000,
    "path": answer().replace('"name":"a"', '"name":"../../../a"'),
    "absolute path": answer(candidate("a", start_checkpoint="/etc/passwd"), candidate("b")),
    "injection": answer().replace('"name":"a"', '"name":"a; touch stolen; $(touch stolen)"'),
    "override": answer().replace('"name":"a"', '"name":"a","trainer.updates":"1"'),
    "many digits": answer().replace("0.2", "1" * 9_000),
    "nested": "[" * 100_000,
    "nothing": "",
    "no text": lambda request: None,
    "bytes": lambda request: answer().encode(),
    "time-out": AdvisorError("no answer within 1 s"),
    "500": AdvisorError("500 Internal Server Error"),
    "crash": ZeroDivisionError("division by zero"),
    "system": OSError("no such program"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_bad_advice_is_on_record_and_never_executed(kind, tmp_path):
    launcher, advisor = FakeTrain(), Scripted(WRONG[kind])
    history = run(make_loop(tmp_path, advisor, launcher, rounds=1))
    [one] = history.rounds
    attempts = json.loads((tmp_path / "rounds" / "001" / "answer.json").read_text())
    assert [attempt["advisor"] for attempt in attempts] == ["scripted", "scripted", "greedy"]
    assert all(attempt["errors"] for attempt in attempts[:2])
    assert attempts[2]["errors"] == []
    assert all(len(attempt["answer"]) <= 20_000 for attempt in attempts)
    assert one.advisor == "greedy"
    assert one.fallback == "; ".join(attempts[1]["errors"])
    assert list(advisor.requests[1].errors) == attempts[0]["errors"]
    expected = greedy(replace(advisor.requests[0], errors=()))
    assert [result.candidate for result in one.results] == Plan.model_validate_json(expected).candidates
    assert len(launcher.commands) == 2
    assert {path.name for path in (tmp_path / "rounds" / "001" / "candidates").glob("*/")} == {"raise-1", "raise-2"}


def test_second_answer_counts(tmp_path):
    advisor = Scripted("no", answer())
    [one] = run(make_loop(tmp_path, advisor, rounds=1)).rounds
    assert (one.advisor, one.fallback, one.note) == ("scripted", "", "why a and b")
    assert [bool(request.errors) for request in advisor.requests] == [False, True]


def test_long_answer_is_kept_as_its_plan(tmp_path):
    advisor = Scripted(answer() + " " * 100_000)
    run(make_loop(tmp_path, advisor, rounds=1))
    kept, plan = tmp_path / "rounds" / "001" / "answer.json", tmp_path / "rounds" / "001" / "plan.json"
    [attempt] = json.loads(kept.read_text())
    assert attempt["answer"] == answer()
    before = plan.read_text()
    plan.unlink()
    plan.with_name("results.json").unlink()
    run(make_loop(tmp_path, advisor, rounds=1))
    assert plan.read_text() == before
    assert len(advisor.requests) == 1


def test_a_plan_changed_by_hand_is_judged(tmp_path):
    with pytest.raises(Killed):
        run(make_loop(tmp_path, launcher=FakeTrain(clock=Clock(0))))
    plan = tmp_path / "rounds" / "001" / "plan.json"
    plan.write_text(plan.read_text().replace('"start"', '"../../x"'))
    with pytest.raises(ConfigError, match=r"plan\.json.*start_checkpoint"):
        run(make_loop(tmp_path))
    plan.write_text("{")
    with pytest.raises(ConfigError, match=r"plan\.json"):
        run(make_loop(tmp_path))


def leak(request) -> str:
    (request.folder / "notes.txt").write_text(SECRET)
    return answer(note=f"a, b: {SECRET}")


@pytest.mark.parametrize(
    "leaky",
    [
        leak,
        lambda request: answer(note=SECRET).replace("/", "\\u002f"),
        lambda request: SECRET * 10_000,
        lambda request: answer().replace("why", SECRET),
        RuntimeError(f"401: key {SECRET} is wrong"),
    ],
    ids=["note", "escaped", "text", "broken", "error"],
)
def test_no_secret_is_written(leaky, tmp_path, monkeypatch):
    monkeypatch.setenv("MY_API_KEY", SECRET)
    monkeypatch.setenv("OTHER_TOKEN", "short")
    launcher = FakeTrain({"001/a": {"exit": 1, "told": SECRET}, "001/raise-1": {"exit": 1, "told": SECRET}})
    (tmp_path / "context.md").write_text("a word of mine")
    history = run(make_loop(tmp_path, Scripted(leaky), launcher, train=[f"logger.key='{SECRET}'"]))
    write_report(history, tmp_path)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(files) > 20
    for path in files:
        text = path.read_bytes()
        for form in (SECRET, json.dumps(SECRET)[1:-1], SECRET.replace("/", "\\/"), "not/told", "not\\u002ftold"):
            assert form.encode() not in text, path
    assert "[removed]" in (tmp_path / "rounds" / "001" / "results.json").read_text()


# ---------------------------------------------------------------- candidates


def make_task(folder: Path, one: Candidate | None = None, start: Result = BASE) -> Task:
    return Task("001/a", folder / "a", one or candidate(), start, Path("/b c/it's, [x]/last.pt"), 100)


def test_command_composes_to_the_plan(tmp_path):
    from hydra import compose, initialize_config_dir

    task = make_task(tmp_path, candidate(collocation_jitter=0.05))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("train", ["+experiment=drift", "seed=9", *overrides(task, ["success"], 7)])
    assert config.schedule._target_ == "pirl_rl.schedules.LossSchedule"
    assert (config.schedule.initial, config.schedule.final) == ([1.0, 0.1, 1.0], [1.0, 0.2, 2.0])
    assert (config.schedule.center, config.schedule.steepness) == (50.0, 0.1)
    assert (config.collocation.jitter, config.collocation.replay_share) == ([0.03, 0.05], [0.9, 0.9])
    assert (config.start, config.seed, config.trainer.updates) == (str(task.path), 7, 100)
    assert (config.stages, config.evaluation.final) == ([], ["success"])


def test_command_as_typed_by_hand_is_in_the_log(tmp_path):
    one = job(make_task(tmp_path), ["seed=3"], [])
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
    job(task, [], [])
    assert not task.folder.exists()
    task.folder.symlink_to(precious)
    with pytest.raises(ConfigError, match="link"):
        job(task, [], [])
    task.folder.unlink()
    task.folder.mkdir()
    (task.folder / "figures").symlink_to(precious)
    with pytest.raises(ConfigError, match="leads out"):
        job(task, [], [])
    assert (precious / "mine").exists()


def test_weights_in_force_at_the_end(tmp_path):
    task = make_task(tmp_path, candidate(schedule_center=99.0, collocation_jitter=0.05))
    task.folder.mkdir()
    write_json(task.folder / "summary.json", {"updates": 100, "wall_seconds": 3.0, **QUIET, "td_loss": float("nan")})
    done = result(task)
    assert (done.status, done.checkpoint, done.updates, done.metrics) == ("done", "001/a", 100, QUIET)
    assert (
        done.weights == LossSchedule((1.0, 0.1, 1.0), (1.0, 0.2, 2.0), 99.0, 0.1)(99) == (1.0, 0.15000000000000002, 1.5)
    )
    assert (done.collocation_jitter, done.collocation_replay_share) == (pytest.approx(0.04), 0.9)
    summary = {"updates": 60, "collapsed_at": 60, "rolled_back_to": 30, **QUIET}
    write_json(task.folder / "summary.json", summary)
    back = result(task)
    assert (back.status, back.checkpoint, back.updates) == ("collapsed", "001/a", 30)
    assert back.weights == task.schedule(29)
    write_json(task.folder / "summary.json", {**summary, "rolled_back_to": 0})
    assert (result(task).updates, result(task).weights, result(task).collocation_jitter) == (0, BASE.weights, 0.03)
    write_json(task.folder / "summary.json", {"updates": 100, **QUIET, "reward": float("nan")})
    assert (result(task).status, result(task).checkpoint) == ("failed", None)
    assert "reward: expected a finite number, got nan" in result(task).reason


def test_failure_is_told_without_paths(tmp_path):
    task = make_task(tmp_path)
    task.log.write_text("much\nerror: /home/me/x.pt does not fit\n")
    settle(task, 1)
    assert json.loads((task.folder / "failed.json").read_text())["log"][-1] == "error: /home/me/x.pt does not fit"
    failed = result(task)
    assert failed.reason == "exit code 1: error: <path> does not fit"
    assert (failed.status, failed.checkpoint, failed.updates) == ("failed", None, 0)


@pytest.mark.parametrize("code", [130, -signal.SIGTERM])
def test_who_is_stopped_has_not_failed(code, tmp_path):
    task = make_task(tmp_path)
    task.log.touch()
    with pytest.raises(KeyboardInterrupt):
        settle(task, code)
    assert not task.ended


def test_failed_candidates_do_not_end_the_loop(tmp_path):
    launcher = FakeTrain({f"{index:03d}/{name}": {"exit": 1, "told": "no"} for index in (1, 2) for name in "ab"})
    advisor = Scripted(lambda request: answer(note="a and b again, as nothing ran"))
    history = run(make_loop(tmp_path, advisor, launcher))
    assert {result.status for result in history.results} == {"failed"}
    assert history.best == BASE
    assert len(launcher.commands) == 4


# ---------------------------------------------------------------- processes


def script(name: str, text: str, folder: Path) -> Job:
    return Job(name, (sys.executable, "-c", f"import os, pathlib, signal, sys, time\n{text}"), folder / f"{name}.log")


def wait_for(condition) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_processes_run_side_by_side_and_keep_their_output(tmp_path):
    meet = "pathlib.Path('{0}').touch()\nwhile not pathlib.Path('{1}').exists(): time.sleep(0.01)\nprint('met {1}')"
    jobs = [script(a, meet.format(tmp_path / a, tmp_path / b), tmp_path) for a, b in ("xy", "yx")]
    jobs.append(script("z", "sys.exit(3)", tmp_path))
    codes = {}
    Processes(2).run(jobs, lambda one, code: codes.update({one.name: code}))
    assert codes == {"x": 0, "y": 0, "z": 3}
    assert "met" in jobs[0].log.read_text()


def test_no_more_processes_than_allowed(tmp_path):
    alone = f"p = pathlib.Path('{tmp_path / 'busy'}')\np.touch(exist_ok=False)\ntime.sleep(0.05)\np.unlink()"
    codes = []
    Processes(1).run([script(name, alone, tmp_path) for name in "abc"], lambda one, code: codes.append(code))
    assert codes == [0, 0, 0]


def test_an_interrupt_lets_the_others_save(tmp_path):
    save = (
        f"signal.signal(signal.SIGINT, lambda *_: (pathlib.Path('{tmp_path / 'saved'}').touch(), sys.exit(130)))\n"
        f"pathlib.Path('{tmp_path / 'ready'}').touch()\ntime.sleep(60)"
    )
    short = f"while not pathlib.Path('{tmp_path / 'ready'}').exists(): time.sleep(0.01)"

    def ended(one, code):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Processes(2).run([script("long", save, tmp_path), script("short", short, tmp_path)], ended)
    assert (tmp_path / "saved").exists()


def test_a_signal_at_any_moment_is_heard(tmp_path):
    """Also in the middle of a fork, where an exception would be lost."""
    sleepers = [script(name, "time.sleep(60)", tmp_path) for name in "abc"]
    once = [lambda: os.kill(os.getpid(), signal.SIGINT)]
    os.register_at_fork(before=lambda: once.pop()() if once else None)
    with pytest.raises(KeyboardInterrupt):
        Processes(3).run(sleepers, lambda one, code: None)
    assert not once
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's death signal is Linux's")
def test_no_child_outlives_a_killed_loop_and_the_lock_waits_for_it(tmp_path):
    text = f"""
import sys
from pathlib import Path
from pirl_rl.outer_loop.directory import locked
from pirl_rl.outer_loop.processes import Job, Processes
with locked(Path({str(tmp_path)!r})) as lock:
    code = "import os, time; open({str(tmp_path / "pid")!r}, 'w').write(str(os.getpid()) + '.'); time.sleep(600)"
    Processes(1, [lock]).run([Job("x", (sys.executable, "-c", code), Path({str(tmp_path / "log")!r}))], print)
"""
    environment = {**os.environ, "PYTHONPATH": str(CONF.parent)}
    loop = subprocess.Popen([sys.executable, "-c", text], env=environment)
    pid = tmp_path / "pid"
    wait_for(lambda: pid.exists() and pid.read_text().endswith("."))
    loop.kill()
    loop.wait()
    with locked(tmp_path):
        assert not Path(f"/proc/{pid.read_text()[:-1]}/cwd").exists()


def test_one_loop_at_a_time(tmp_path):
    with locked(tmp_path), pytest.raises(ConfigError, match="another loop"), locked(tmp_path):
        pass
    with locked(tmp_path):
        pass


# ---------------------------------------------------------------- start


def test_weights_of_the_start_are_those_of_its_last_update(tmp_path):
    from pirl_rl import checkpoint
    from pirl_rl.assembly import begin

    schedule = (
        "{updates: 5, schedule: {_target_: pirl_rl.schedules.LinearSchedule, initial: [1, 0, 1], final: [1, 1, 3]"
    )
    visited = "{_target_: pirl_rl.collocation.ReplayCollocation, jitter: [0.1, 0.2], replay_share: [1, 0.5]}"
    stages = f"stages=[{{updates: 5}}, {schedule}, start: 0, end: 5}}, collocation: {visited}}}]"
    trainer = small_trainer(tmp_path / "before", stages, "trainer.updates=10", "evaluation.final=[success,calibration]")
    trainer.train()
    collocation = "collocation._target_=pirl_rl.collocation.ReplayCollocation"
    candidates = small_trainer(tmp_path / "next", collocation, "evaluation.final=[success,calibration]")
    path = begin(candidates, str(tmp_path / "before"))
    begun = measure(candidates, path)
    assert begun.weights == pytest.approx((1, 0.8, 2.6))
    assert (begun.collocation_jitter, begun.collocation_replay_share) == (pytest.approx(0.18), pytest.approx(0.6))
    assert {"reward", "calibration_mae", "success_low"} <= begun.metrics.keys()
    early = begin(candidates, str(checkpoint.weights_path(path.parent, 5)))
    assert measure(candidates, early).weights == trainer.learner.schedule(4)
    plain = small_trainer(tmp_path / "plain", "evaluation.final=[success,calibration]")
    begun = measure(plain, begin(plain, str(path)))
    assert (begun.collocation_jitter, begun.collocation_replay_share) == (None, None)


# ---------------------------------------------------------------- command line


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run to start from."""
    folder = tmp_path_factory.mktemp("trained")
    small_trainer(folder, "trainer.updates=20").train()
    return folder


@pytest.fixture
def cli(tmp_path, monkeypatch, capfd):
    """Runs the command in this process with a fake training: (exit code, what it printed)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tune, "Processes", lambda parallel, inherited: FakeTrain())

    def call(*arguments: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["tune", *arguments])
        code = 0
        try:
            tune.main()
        except SystemExit as stop:
            code = stop.code
        printed = capfd.readouterr()
        return code, printed.out + printed.err

    return call


def test_command_line(cli, trained, tmp_path):
    typed = (*SMALL, f"start={trained}", "rounds=1", "out='my out'", "updates=10")
    code, text = cli(*typed)
    assert code == 0, text
    out = tmp_path / "my out"
    assert {path.name for path in out.iterdir()} == {
        *("tune.yaml", "context.md", "baseline.json", "rounds", "report.md", "tree.png", LOCK)
    }
    assert f"best     {out / 'rounds' / '001' / 'candidates'}" in text
    baseline = json.loads((out / "baseline.json").read_text())
    config = load_config(trained)
    last = LossSchedule(config.pirl.initial, config.pirl.final, config.schedule.center, config.schedule.steepness)(19)
    assert baseline["weights"] == list(last)
    commands = [path.read_text().splitlines()[0] for path in sorted(out.rglob("*.log"))]
    for line in commands:
        words = shlex.split(line)
        assert words[4] == "trainer.rollback=true"
        assert words[5 : 5 + len(SMALL)] == list(SMALL)
        assert {"evaluation.final=[success,residuals,calibration]", "trainer.updates=10", "seed=1"} <= {*words}
        assert f"start='{trained / 'checkpoints' / 'last.pt'}'" in words

    code, text = cli(*typed, "seed=4", "advisor.growth=3")
    assert code == 1
    assert "seed, advisor.growth: expected the settings of" in text
    code, text = cli(*typed[:3], *typed[4:], "rounds=2", "env.num_envs=32", "parallel=2")
    assert code == 1
    code, text = cli(*typed, "rounds=2", "parallel=2")
    assert code == 0, text
    assert len(list(out.rglob("summary.json"))) == 4
    before = (out / "report.md").read_text()
    (out / "report.md").unlink()
    code, text = cli("--report", "out=my out")
    assert code == 0, text
    assert (out / "report.md").read_text() == before
    with locked(out):
        code, text = cli(*typed, "rounds=2", "parallel=2")
    assert code == 1
    assert "another loop" in text


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["start=null"], "start: expected a run directory"),
        (["start=nowhere"], "no checkpoint at nowhere"),
        (["rounds=0"], "rounds: expected an integer >= 1, got 0"),
        (["candidates=x"], "candidates: expected int, got 'x'"),
        (["extra_rounds=-1"], "extra_rounds"),
        (["updates=0"], "updates"),
        (["updats=3"], "updats"),
        (["trainer.updats=3"], "updats"),
        (["trainer.log_every=0"], "trainer.log_every"),
        (["trainer.updates=3"], "trainer.updates=3: expected no trainer.updates here"),
        (["schedule.center=3"], "schedule.center=3: expected no schedule.center here"),
        (["schedule=linear"], "schedule=linear"),
        (["resume=run"], "resume=run"),
        (["+stages=[]"], "stages"),
        (["evaluation.final=[exact]"], "evaluation.final"),
        (["~evaluation.calibration"], "evaluation: expected success and calibration"),
        (["advisor=nope"], "nope"),
        (["advisor.growth=0"], "advisor: growth"),
        (["advisor=command"], "advisor.command: a value is missing"),
        (["critic.activation=ReLU"], "ReLU"),
        (["critic.hidden=[8]"], "does not fit"),
        (["out=."], "not empty and no loop's directory"),
        (["seed=1,2", "-m"], "-m: a loop runs its candidates itself"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_mistakes_are_named_and_leave_nothing(arguments, told, cli, trained, tmp_path):
    (tmp_path / "mine").touch()
    code, text = cli(*SMALL, f"start={trained}", *arguments)
    assert code == 1, text
    assert told in text
    assert "Traceback" not in text
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_report_needs_a_loop(cli, tmp_path):
    code, text = cli("--report", f"out={tmp_path}")
    assert (code, "no loop's directory" in text) == (1, True)
    code, text = cli("--report")
    assert (code, "expected out=DIR" in text) == (1, True)


def test_report_of_many(tmp_path):
    history = run(make_loop(tmp_path, rounds=3, candidates=4))
    history.rounds[0].results[0].metrics.pop("success_rate")
    table, figure = write_report(history, tmp_path)
    rows = [line for line in table.read_text().splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + 1 + 12
    assert figure.read_bytes().startswith(b"\x89PNG")
    hostile = history.rounds[0].model_copy(update={"note": "<script>\n| # [x](y)"})
    text = markdown(history.model_copy(update={"rounds": [hostile]}))
    assert r"\<script\> \| \# \[x\](y)" in text


# ---------------------------------------------------------------- real training


def real(out: str, trained: Path, *arguments: str) -> list[str]:
    return [*SMALL, f"start={trained}", "updates=40", f"out={out}", "trainer.checkpoint_every=5", *arguments]


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(CONF.parent), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "pirl_rl.tune", *arguments]
    return subprocess.Popen(
        line, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def decided(out: Path) -> dict[str, str]:
    """Plans and results, and the training of each candidate, as they are on disk."""
    names = ("plan.json", "results.json", "answer.json", "prompt.md", "metrics.csv")
    found = {path: path.read_text() for path in out.rglob("*") if path.name in names}
    return {str(path.relative_to(out)): text for path, text in sorted(found.items())}


@pytest.mark.slow
@pytest.mark.parametrize("advisor", ["greedy", "file", "optuna"])
def test_three_rounds(advisor, trained, tmp_path):
    settings = [f"advisor={advisor}", "candidates=1", "rounds=3"]
    if advisor == "file":
        plans = [json.loads(answer(candidate(name, schedule_final=(1, 0.1 * i, 1)))) for i, name in enumerate("abc", 1)]
        plans[2]["candidates"][0]["start_checkpoint"] = "002/b"
        write_json(tmp_path / "plans.json", plans)
        settings.append("advisor.path=plans.json")
    done = command(*real("out", trained, *settings), cwd=tmp_path, module="pirl_rl.tune")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    for number in (1, 2, 3):
        one = json.loads((tmp_path / "out" / "rounds" / f"{number:03d}" / "results.json").read_text())
        assert (one["advisor"], one["fallback"]) == (advisor, "")
        [result] = one["results"]
        assert result["status"] == "done", result
        assert {"reward", "success_rate", "calibration_mae", "td_loss", "hjb_loss"} <= result["metrics"].keys()
    if advisor == "file":
        assert best_path(Record(tmp_path / "out").history(BASE, 1.0))[0] == "start"
        assert result["updates"] == 80


@pytest.mark.slow
def test_parallel_changes_nothing(trained, tmp_path):
    settings = ("rounds=1", "candidates=2")
    for parallel in (1, 2):
        line = real(f"out{parallel}", trained, *settings, f"parallel={parallel}")
        assert command(*line, cwd=tmp_path, module="pirl_rl.tune").returncode == 0
    assert decided(tmp_path / "out1") == decided(tmp_path / "out2")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_saves_and_tells_how_to_go_on(number, trained, tmp_path):
    loop = start(tmp_path, *real("out", trained, "rounds=1", "candidates=1", "updates=1000000"))
    run = tmp_path / "out" / "rounds" / "001" / "candidates" / "raise-1"
    wait_for(lambda: (run / "checkpoints" / "last.pt").exists())
    loop.send_signal(number)
    text = loop.communicate(timeout=60)[1]
    assert loop.returncode == 130
    assert "go on with: python -m pirl_rl.tune " in text
    assert "Traceback" not in text
    assert (run.parent / "raise-1.log").read_text().count("resume=") == 1
    assert not (run / "failed.json").exists()
    again = start(tmp_path, *shlex.split(text.rpartition("pirl_rl.tune ")[2]))
    wait_for(lambda: (run.parent / "raise-1.log").read_text().count("resume=") > 1)
    again.send_signal(number)
    again.communicate(timeout=60)
    assert again.returncode == 130


@pytest.mark.slow
def test_sigkill_at_random_moments_leads_to_the_same_tree(trained, tmp_path):
    settings = ("rounds=3", "candidates=2")
    began = time.monotonic()
    done = command(*real("whole", trained, *settings), cwd=tmp_path, module="pirl_rl.tune")
    assert done.returncode == 0, done.stderr
    took = time.monotonic() - began
    rng = random.Random(0)
    for _ in range(10):
        loop = start(tmp_path, *real("killed", trained, *settings))
        try:
            loop.communicate(timeout=rng.uniform(0.1, 0.6) * took)
        except subprocess.TimeoutExpired:
            loop.kill()
            loop.communicate()
    done = command(*real("killed", trained, *settings), cwd=tmp_path, module="pirl_rl.tune")
    assert done.returncode == 0, done.stderr
    assert decided(tmp_path / "killed") == decided(tmp_path / "whole")
