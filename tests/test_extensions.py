"""The examples of docs/extending.md: each file and its command run as they stand there, from an empty directory."""

from __future__ import annotations

import csv
import importlib
import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from small import STEPS, small_config

import pirl_rl
from pirl_rl import checkpoint
from pirl_rl.assembly import make_trainer

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "extensions"
PAGE = (ROOT / "docs" / "extending.md").read_text()
SHORT = ("+debug=default", "figures=false", *STEPS, "env.num_envs=64", "trainer.updates=30", "trainer.log_every=1")


@pytest.fixture
def run_command(in_process, monkeypatch):
    """`run_command(module)` runs the page's command that names a module, from an empty directory: what it printed.

    Further arguments cut the command to seconds, and keyword arguments replace words of it that stand for something.
    """
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (ROOT, EXAMPLES))))  # for processes that it starts

    def run(module: str, *more: str, **replaced: str) -> str:
        [line] = re.findall(rf"^python -m (.*_target_={module}\..*)$", PAGE, re.MULTILINE)
        for word, meaning in replaced.items():
            line = line.replace(word, meaning)
        name, *arguments = shlex.split(line)
        code, text = in_process(importlib.import_module(name))(*arguments, *more)
        assert code == 0, text
        return text

    return run


@pytest.fixture
def run_of(run_command, tmp_path):
    """`run_of(module)` is the directory of a run of the page's command, and what the command printed."""

    def run(module: str, *more: str) -> tuple[Path, str]:
        printed = run_command(module, *SHORT, *more)
        [folder] = (tmp_path / "runs").glob("*/*")
        return folder, printed

    return run


def test_every_example_is_on_the_page():
    assert set(re.findall(r"literalinclude\} extensions/(\w+\.py)", PAGE)) == {
        path.name for path in EXAMPLES.glob("*.py")
    }


def test_problem(run_of):
    """V is 1 at the pier and 0 on the rocks, whatever the networks say, and the command's wind is in force."""
    run = pirl_rl.load_run(run_of("my_problem")[0], trust=["my_problem"])
    assert run.problem.wind == -0.3
    np.testing.assert_array_equal(run.value(2.0, np.array([[1.2], [-1.2]])), [1.0, 0.0])
    x, u = torch.tensor([[0.5]]), torch.tensor([[0.25]])
    torch.testing.assert_close(run.problem.drift(x, u), torch.tensor([[-0.05]]))


def test_actor_rule(run_of):
    """The run used the rule, and its objective is the Hamiltonian less the price of the actions."""
    run, _ = run_of("my_rule")
    assert json.loads((run / "summary.json").read_text())["updates"] == 30

    own = ("pirl.actor_rule._target_=my_rule.GentleHamiltonian", "+pirl.actor_rule.effort=0.02")
    loss = make_trainer(small_config(*own), trust=["my_rule"]).learner.loss
    tau, x = torch.rand(50, 1), torch.randn(50, 1)
    points = {"tau": tau, "state": x, "mask": torch.ones(50, dtype=torch.bool)}
    solution = loss.solution()
    price = loss.actor_rule.hamiltonian(solution, points, points) - loss.actor_rule(solution, points, points)
    torch.testing.assert_close(price, 0.02 * solution.actor(tau, x).square().mean())


def test_schedule(run_of):
    """The weights are (1, 0, 0) before three tenths of the 30 updates, and those of the method's end from there on."""
    with (run_of("my_schedule")[0] / "metrics.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["hjb_weight"]]
    weights = {int(row["update"]): (float(row["td_weight"]), float(row["hjb_weight"])) for row in rows}
    assert set(weights.values()) == {(1.0, 0.0), (1.0, 1.0)}
    first = min(update for update, (_, hjb) in weights.items() if hjb)
    assert {hjb for update, (_, hjb) in weights.items() if update >= first} == {1.0}
    assert first == 10  # rows count updates from 1, schedules from 0


def test_evaluator(run_of):
    run, text = run_of("my_evaluator", "figures=true")
    summary = json.loads((run / "summary.json").read_text())
    assert 0 < summary["arrival_share"] < 1
    assert 0 < summary["arrival_time"] <= 2
    assert (run / "figures" / "arrivals.png").stat().st_size > 0
    printed = " ".join(text.split())
    paths = "1,000 paths of 2 s from random states in the box"
    assert f"The share of {paths} that reaches the target." in printed
    assert f"The mean time of arrival in s of those of {paths} that reach the target." in printed


def test_collector(run_of):
    """50 / 5 updates lie between two batches: one is the warm-up, others are played before updates 0, 10 and 20."""
    run, _ = run_of("my_collector")
    state = checkpoint.load(run / "checkpoints" / "last.pt")
    assert state["collector"]["frames"] == 4 * 512


def test_advisor(tmp_path, trained, run_command):
    """The first plan continues from the start with 1.2 times its HJB weight, and its candidate is trained."""
    small = ("+debug=default", *STEPS, "env.num_envs=32", "collector.frames_per_batch=64")
    small += ("collector.warmup_frames=64", "figures=false")
    loop = ("rounds=1", "candidates=1", "updates=10", "out=loop")
    run_command("my_advisor", *small, *loop, RUN_DIR=str(trained))
    [plan] = (tmp_path / "loop").glob("rounds/*/plan.json")
    [candidate] = json.loads(plan.read_text())["candidates"]
    assert candidate["name"] == "rung-1"
    assert candidate["schedule_final"][1] == pytest.approx(1.2 * candidate["schedule_initial"][1])
    [summary] = (tmp_path / "loop").rglob("candidates/rung-1/summary.json")
    assert json.loads(summary.read_text())["updates"] == 10
