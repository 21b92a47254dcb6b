"""The examples of docs/extending.md: each file and its command run as they stand there, from an empty directory."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from small import command, small_config

import pirl_rl
from pirl_rl import checkpoint
from pirl_rl.assembly import make_trainer

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs" / "extensions"
PAGE = (ROOT / "docs" / "extending.md").read_text()
SHORT = ("+debug=default", "env.num_envs=64", "trainer.updates=30", "trainer.log_every=1")


def run_command(module: str, folder: Path, *more: str, **replaced: str) -> str:
    """Run the page's command that names a module, from an empty directory: what it printed.

    Args:
        module: the example's.
        folder: the directory.
        more: arguments that cut the command to seconds.
        replaced: words of the command that stand for something, and what they stand for.
    """
    [line] = re.findall(rf"^python -m (.*_target_={module}\..*)$", PAGE, re.MULTILINE)
    for word, meaning in replaced.items():
        line = line.replace(word, meaning)
    name, *arguments = shlex.split(line)
    path = os.pathsep.join(map(str, (ROOT, EXAMPLES)))
    done = command(*arguments, *more, cwd=folder, module=name, PYTHONPATH=path)
    assert done.returncode == 0, done.stderr
    return done.stdout


def run_of(module: str, folder: Path) -> Path:
    """The directory of a run of the page's command."""
    (folder / "printed.txt").write_text(run_command(module, folder, *SHORT))
    [run] = (folder / "runs").glob("*/*")
    return run


@pytest.fixture
def examples(monkeypatch):
    """The examples can be imported."""
    monkeypatch.syspath_prepend(str(EXAMPLES))


def test_every_example_is_on_the_page():
    assert set(re.findall(r"literalinclude\} extensions/(\w+\.py)", PAGE)) == {
        path.name for path in EXAMPLES.glob("*.py")
    }


def test_problem(tmp_path, examples):
    """V is 1 at the pier and 0 on the rocks, whatever the networks say, and the command's wind is in force."""
    run = pirl_rl.load_run(run_of("my_problem", tmp_path), trust=["my_problem"])
    assert run.problem.wind == -0.3
    np.testing.assert_array_equal(run.value(2.0, np.array([[1.2], [-1.2]])), [1.0, 0.0])
    x, u = torch.tensor([[0.5]]), torch.tensor([[0.25]])
    torch.testing.assert_close(run.problem.drift(x, u), torch.tensor([[-0.05]]))


def test_actor_rule(tmp_path, examples):
    """The run used the rule, and its objective is the Hamiltonian less the price of the actions."""
    run = run_of("my_rule", tmp_path)
    assert json.loads((run / "summary.json").read_text())["updates"] == 30

    own = ("pirl.actor_rule._target_=my_rule.GentleHamiltonian", "+pirl.actor_rule.effort=0.02")
    loss = make_trainer(small_config(*own), trust=["my_rule"]).learner.loss
    tau, x = torch.rand(50, 1), torch.randn(50, 1)
    points = {"tau": tau, "state": x, "mask": torch.ones(50, dtype=torch.bool)}
    solution = loss.solution()
    price = loss.actor_rule.hamiltonian(solution, points, points) - loss.actor_rule(solution, points, points)
    torch.testing.assert_close(price, 0.02 * solution.actor(tau, x).square().mean())


def test_schedule(tmp_path):
    """The weights are (1, 0, 0) before three tenths of the 30 updates, and those of the method's end from there on."""
    with (run_of("my_schedule", tmp_path) / "metrics.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["hjb_weight"]]
    weights = {int(row["update"]): (float(row["td_weight"]), float(row["hjb_weight"])) for row in rows}
    assert set(weights.values()) == {(1.0, 0.0), (1.0, 1.0)}
    first = min(update for update, (_, hjb) in weights.items() if hjb)
    assert {hjb for update, (_, hjb) in weights.items() if update >= first} == {1.0}
    assert first == 10  # rows count updates from 1, schedules from 0


def test_evaluator(tmp_path):
    run = run_of("my_evaluator", tmp_path)
    summary = json.loads((run / "summary.json").read_text())
    assert 0 < summary["arrival_share"] < 1
    assert 0 < summary["arrival_time"] <= 2
    assert (run / "figures" / "arrivals.png").stat().st_size > 0
    printed = " ".join((tmp_path / "printed.txt").read_text().split())
    paths = "1,000 paths of 2 s from random states in the box"
    assert f"The share of {paths} that reaches the target." in printed
    assert f"The mean time of arrival in s of those of {paths} that reach the target." in printed


def test_collector(tmp_path):
    """50 / 5 updates lie between two batches: one is the warm-up, others are played before updates 0, 10 and 20."""
    run = run_of("my_collector", tmp_path)
    state = checkpoint.load(run / "checkpoints" / "last.pt")
    assert state["collector"]["frames"] == 4 * 512


def test_advisor(tmp_path, trained):
    """The first plan continues from the start with 1.2 times its HJB weight, and its candidate is trained."""
    small = ("+debug=default", "env.num_envs=32", "collector.frames_per_batch=64", "collector.warmup_frames=64")
    loop = ("rounds=1", "candidates=1", "updates=10", "out=loop")
    run_command("my_advisor", tmp_path, *small, *loop, RUN_DIR=str(trained))
    [plan] = (tmp_path / "loop").glob("rounds/*/plan.json")
    [candidate] = json.loads(plan.read_text())["candidates"]
    assert candidate["name"] == "rung-1"
    assert candidate["schedule_final"][1] == pytest.approx(1.2 * candidate["schedule_initial"][1])
    [summary] = (tmp_path / "loop").rglob("candidates/rung-1/summary.json")
    assert json.loads(summary.read_text())["updates"] == 10
