"""The record of a loop: a killed loop can be resumed from any moment, and no file holds a secret."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from rounds import Clock, FakeTrain, Killed, Scripted, answer, greedy, make_loop, run

import pirl_rl.files
from pirl_rl.errors import ConfigError
from pirl_rl.outer_loop.directory import LOCK, locked
from pirl_rl.outer_loop.report import write_report

SECRET = 'sk-"not/told'


def slow(request) -> str:
    """Learns from its errors."""
    return answer(note=f"a and b, round {request.number}") if request.errors else "no"


def tree(out: Path) -> dict[str, str]:
    """The files with all decisions and results of a loop."""
    found = (path for path in out.rglob("*") if path.is_file() and path.suffix != ".log" and path.name != LOCK)
    kept = {str(path.relative_to(out)): path for path in found if path.suffix != ".pt"}
    return {name: _timeless(path).replace(str(out), "out") for name, path in kept.items()}


def _timeless(path: Path) -> str:
    if path.name != "summary.json":
        return path.read_text()
    return str({name: v for name, v in json.loads(path.read_text()).items() if "second" not in name})


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


def test_one_loop_at_a_time(tmp_path):
    with locked(tmp_path), pytest.raises(ConfigError, match="another loop"), locked(tmp_path):
        pass
    with locked(tmp_path):
        pass
