"""The README's own example: its problem trains by its command, and its Python blocks train it and open a run."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pirl_rl.simulator import Simulator

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
PROBLEM, TRAIN, OPEN = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
COMMAND = re.search(r"^python (-m pirl_rl\.train \+experiment=own .*)$", README, re.MULTILINE)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A directory with nothing but the README's `my_module.py`."""
    home = tmp_path_factory.mktemp("own")
    (home / "my_module.py").write_text(PROBLEM)
    return home


@pytest.fixture(scope="module")
def run_folder(home):
    """A run of the README's problem by its command in debug settings."""
    assert COMMAND
    command = [sys.executable, *shlex.split(COMMAND[1]), "+debug=default", "trainer.updates=30"]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(command, cwd=home, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    [folder] = (home / "runs" / "own").iterdir()
    return folder


def test_the_command_trains(run_folder):
    summary = json.loads((run_folder / "summary.json").read_text())
    assert summary["updates"] == 30
    assert 0 <= summary["success_low"] <= summary["success_rate"] <= summary["success_high"] <= 1
    assert {path.name for path in run_folder.iterdir()} == {
        "summary.json",
        "metrics.csv",
        "checkpoints",
        "figures",
        ".hydra",
    }


def test_the_python_block_opens_the_run(run_folder, home, monkeypatch):
    monkeypatch.syspath_prepend(str(home))
    block, opened = re.subn(r'load_run\("[^"]+"', f"load_run({str(run_folder)!r}", f"import pirl_rl\n{OPEN}")
    assert opened == 1
    names = {}
    exec(block, names)
    assert names["run"].update == 30


def test_the_python_block_trains(home, tmp_path, monkeypatch):
    """The third state lies in the drain: V and its Monte Carlo are exactly 0, and its path has failed."""
    monkeypatch.syspath_prepend(str(home))
    monkeypatch.chdir(tmp_path)
    quick = "updates=30, debug='default', figures=False, evaluation={'final': []}"
    block, shortened = re.subn(r"\(Whirlpool, ", f"(Whirlpool, {quick}, ", TRAIN)
    assert shortened == 1
    names = {}
    exec(block, names)
    value, check, paths = names["value"], names["check"], names["paths"]
    np.testing.assert_array_equal(names["inside"], value > 0.5)
    assert value[2] == check.probability[2] == check.high[2] == 0
    assert paths.failed[2]
    assert not paths.reached[2]
    assert (np.abs(names["control"]) <= 1).all()
    assert (check.low <= check.probability).all()
    assert (check.probability <= check.high).all()


def test_the_readme_problem_obeys_its_sde():
    """Euler-Maruyama over one small step has the mean and covariance that the docstring's equation states.

    10^5 draws over h = 0.01: standard errors 1.9e-4 of the mean, 1.6e-5 of a variance of 3.6e-3; bounds: five.
    """
    names = {}
    exec(PROBLEM, names)
    x, u, h = torch.tensor([0.5, 0.5]), torch.tensor([0.3, -0.7]), 0.01
    step = Simulator(names["Whirlpool"](), dt=h, crossing="endpoint").step(
        x.expand(100_000, 2), u.expand(100_000, 2), torch.Generator().manual_seed(0)
    )
    swirl = torch.tensor([-0.5 * 0.5 - 0.5, 0.5 - 0.5 * 0.5])
    torch.testing.assert_close(step.state.mean(0), x + h * (u + swirl), atol=1e-3, rtol=0)
    torch.testing.assert_close(torch.cov(step.state.T), 0.36 * h * torch.eye(2), atol=8e-5, rtol=0)
