"""The command `tune`, with a fake training and with real ones."""

from __future__ import annotations

import json
import shlex
import sys

import pytest
from rounds import FakeTrain, answer, candidate
from small import TUNED, small_trainer

from pirl_rl.commands import tune
from pirl_rl.configuration import load_config
from pirl_rl.outer_loop.directory import LOCK, locked
from pirl_rl.schedules import LossSchedule


@pytest.fixture
def cli(in_process, monkeypatch):
    """The command with a fake training."""
    monkeypatch.setattr(tune, "Processes", lambda parallel, inherited: FakeTrain())
    return in_process(tune)


def test_command_line(cli, trained, tmp_path):
    typed = (*TUNED, f"start={trained}", "rounds=1", "out='my out'", "updates=10")
    code, text = cli(*typed)
    assert code == 0, text
    out = tmp_path / "my out"
    assert {path.name for path in out.iterdir()} == {
        *("tune.yaml", "context.md", "baseline.json", "rounds", "report.md", "tree.png", LOCK)
    }
    assert f"best     {out / 'rounds' / '001' / 'candidates'}" in text
    baseline = json.loads((out / "baseline.json").read_text())
    config = load_config(trained)
    schedule = LossSchedule(config.pirl.initial, config.pirl.final, config.schedule.center, config.schedule.steepness)
    last = schedule(19, 20)
    assert baseline["weights"] == list(last)
    commands = [path.read_text().splitlines()[0] for path in sorted(out.rglob("*.log"))]
    for line in commands:
        words = shlex.split(line)
        assert words[4] == "trainer.rollback=true"
        assert words[5 : 5 + len(TUNED)] == list(TUNED)
        assert {"evaluation.final=[success,residuals,calibration]", "trainer.updates=10", "seed=1"} <= {*words}
        assert "trainer.evaluate_every=1" in words
        assert f"start='{trained / 'checkpoints' / 'last.pt'}'" in words

    code, text = cli(*typed, "seed=4", "advisor.growth=3")
    assert code == 1
    assert "seed, advisor.growth: expected the settings of" in text
    code, text = cli(*typed[:2], *typed[3:], "rounds=2", "env.num_envs=32", "parallel=2")
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
        (["population=3"], "population: expected bool"),
        (["population=true", "parallel=2"], "parallel: expected 1 with population=true"),
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
        (["out=."], "out: expected an empty directory or one with tune.yaml"),
        (["--config-dir=mine"], "--config-dir=mine: a loop composes its candidates from the choices of the package"),
        (["seed=1,2", "-m"], "-m: a loop runs its candidates itself"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_mistakes_are_named_and_leave_nothing(arguments, told, cli, trained, tmp_path):
    (tmp_path / "mine").touch()
    code, text = cli(*TUNED, f"start={trained}", *arguments)
    assert code == 1, text
    assert told in text
    assert "Traceback" not in text
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_program_s_line_is_typed_as_for_any_shell(cli, trained, tmp_path):
    (tmp_path / "my plan.json").write_text(answer(candidate("a"), candidate("b")))
    typed = shlex.split(f"""advisor=command advisor.command="cp '{tmp_path}/my plan.json' {{plan}}" """)
    line = (*TUNED, f"start={trained}", "rounds=1", "out=out", "updates=10")
    code, text = cli(*line, *typed)
    assert code == 0, text
    assert "round 1 (command)" in text
    resumed = sys.argv[1:]  # the hint on how to resume repeats the arguments
    assert resumed[-1] != typed[-1]
    assert cli(*resumed)[0] == 0
    assert sys.argv[1:] == resumed


def test_the_candidates_have_the_method_of_their_start(cli, trained, tmp_path):
    td3 = tmp_path / "td3"
    small_trainer(td3, "method=td3", "trainer.updates=5").train()
    line = (*TUNED, "rounds=1", "candidates=1", "updates=10")
    for start, typed, expected in ((td3, (), "td3"), (td3, ("method=td3",), "td3"), (trained, (), None)):
        out = tmp_path / f"{start.name}-{len(typed)}"
        code, text = cli(*line, *typed, f"start={start}", f"out={out}")
        assert code == 0, text
        (log,) = out.rglob("*.log")
        words = shlex.split(log.read_text().splitlines()[0])
        assert [word for word in words if word.startswith("method=")] == ([f"method={expected}"] if expected else [])
    code, text = cli(*line, "method=pirl", f"start={td3}")
    assert code == 1
    assert "does not fit" in text


def test_report_needs_a_loop(cli, tmp_path):
    code, text = cli("--report", f"out={tmp_path}")
    assert (code, "expected a directory with tune.yaml" in text) == (1, True)
    code, text = cli("--report")
    assert (code, "expected out=DIR" in text) == (1, True)
