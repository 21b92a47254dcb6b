"""The command line of the outer loop, with a fake training and with real ones."""

from __future__ import annotations

import json
import os
import random
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rounds import BASE, FakeTrain, answer, candidate, write_json
from small import command, small_trainer, wait_for

from pirl_rl import tune
from pirl_rl.configuration import CONF, load_config
from pirl_rl.outer_loop.directory import LOCK, locked
from pirl_rl.outer_loop.record import Record
from pirl_rl.outer_loop.tree import best_path
from pirl_rl.schedules import LossSchedule

SMALL = ("+experiment=reach1d", "+debug=default", "env.num_envs=32", "collector.frames_per_batch=64")
SMALL += ("collector.warmup_frames=64",)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run to start from."""
    folder = tmp_path_factory.mktemp("trained")
    small_trainer(folder, "trainer.updates=20").train()
    return folder


@pytest.fixture
def cli(in_process, monkeypatch):
    """The command with a fake training."""
    monkeypatch.setattr(tune, "Processes", lambda parallel, inherited: FakeTrain())
    return in_process(tune)


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
        (["updats=3"], "updats"),
        (["trainer.log_every=0"], "trainer.log_every"),
        (["trainer.updates=3"], "trainer.updates=3: expected no trainer.updates here"),
        (["schedule.center=3"], "schedule.center=3: expected no schedule.center here"),
        (["schedule=linear"], "schedule=linear"),
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


def test_a_program_s_line_is_typed_as_for_any_shell(cli, trained, tmp_path):
    (tmp_path / "my plan.json").write_text(answer(candidate("a"), candidate("b")))
    typed = shlex.split(f"""advisor=command advisor.command="cp '{tmp_path}/my plan.json' {{plan}}" """)
    line = (*SMALL, f"start={trained}", "rounds=1", "out=out", "updates=10")
    code, text = cli(*line, *typed)
    assert code == 0, text
    assert "round 1 (command)" in text
    resumed = sys.argv[1:]  # what the hint repeats
    assert resumed[-1] != typed[-1]
    assert cli(*resumed)[0] == 0
    assert sys.argv[1:] == resumed


def test_report_needs_a_loop(cli, tmp_path):
    code, text = cli("--report", f"out={tmp_path}")
    assert (code, "no loop's directory" in text) == (1, True)
    code, text = cli("--report")
    assert (code, "expected out=DIR" in text) == (1, True)


# Real trainings.


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


@pytest.fixture
def hearing():
    """A shell lets what it starts in the background ignore SIGINT, which is passed on to all that is started here."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.slow
@pytest.mark.usefixtures("hearing")
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
