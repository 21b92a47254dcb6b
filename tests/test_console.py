"""Reports of errors by the commands: a refused setting or a bug of the user is one line, another has its traceback."""

from __future__ import annotations

import inspect
import shlex
import sys
from pathlib import Path

import pytest
from hydra.errors import CompactHydraException
from omegaconf import OmegaConf
from small import QUICK

from pirl_rl import train
from pirl_rl.building import build
from pirl_rl.commands.console import named_modules, reported
from pirl_rl.errors import ArgumentError, ConfigError, PlanError
from pirl_rl.problems import Reach1D

OWN = ("+experiment=own", *QUICK[1:])

BROKEN = """
import torch
from pirl_rl.errors import ArgumentError
from pirl_rl.problems import Reach1D

class Buggy(Reach1D):
    def drift(self, x, u):
        return self.speed * u

class Choosy(Reach1D):
    def __init__(self):
        raise ArgumentError("speed: expected a number > 0, got -1")

class Mistaken(Reach1D):
    def __init__(self):
        raise ValueError("what is this")

class Library(Reach1D):
    def drift(self, x, u):
        return torch.cat([x, u.mT], -1)


import os, signal
from pirl_rl.loggers import CSVLogger

class Interrupts(CSVLogger):
    def log(self, row):
        super().log(row)
        os.kill(os.getpid(), signal.SIGINT)


class Missing(Reach1D):
    def __init__(self):
        open("nowhere.csv")
"""


@pytest.fixture
def cli(in_process, tmp_path, monkeypatch):
    (tmp_path / "broken.py").write_text(BROKEN)
    (tmp_path / "unreadable.py").write_text("class Half(:\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield in_process(train)
    for name in ("broken", "unreadable"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("target", "line", "last"),
    [
        ("broken.Buggy", 8, "error: AttributeError: 'Buggy' object has no attribute 'speed'"),
        ("broken.Mistaken", 16, "error: ValueError: what is this"),
        ("broken.Library", 20, "error: RuntimeError: Sizes of tensors must match"),
        ("broken.Missing", 34, "error: FileNotFoundError: [Errno 2] No such file or directory: 'nowhere.csv' ("),
        ("unreadable.Half", 1, "error: SyntaxError: invalid syntax"),
    ],
)
@pytest.mark.parametrize("full", [False, True])
def test_a_bug_of_the_user_s_is_one_line_with_its_place(full, target, line, last, cli, tmp_path, monkeypatch):
    before = sorted(path.name for path in tmp_path.iterdir())
    monkeypatch.setenv("HYDRA_FULL_ERROR", str(int(full)))
    code, text = cli(*OWN, f"env.problem._target_={target}")
    assert code == 1
    assert ("Traceback (most recent call last)" in text) == full
    final = text.strip().splitlines()[-1]
    assert final.startswith(last)
    assert final.endswith(f"({tmp_path / target.partition('.')[0]}.py, line {line})")
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "__pycache__") == before


def test_a_refusal_is_one_line(cli):
    code, text = cli(*OWN, "env.problem._target_=broken.Choosy")
    assert (code, text) == (1, "error: env.problem: speed: expected a number > 0, got -1\n")


def test_build_leaves_other_errors_alone(cli):
    node = OmegaConf.create({"_target_": "broken.Mistaken"})
    with pytest.raises(ValueError, match="what is this") as caught:
        build(node, "problem", ["broken"])
    assert not isinstance(caught.value, ConfigError)
    with pytest.raises(ConfigError, match="problem: speed: expected"):
        build(OmegaConf.create({"_target_": "broken.Choosy"}), "problem", ["broken"])
    with pytest.raises(ConfigError, match="problem: ReachAvoidProblem lacks diffusion, drift"):
        build(OmegaConf.create({"_target_": "pirl_rl.problem.ReachAvoidProblem"}), "problem")


@pytest.mark.parametrize("trust", ["mine", "'mine'", "[mine]", "['mine']", ["mine"]])
def test_one_module_needs_no_brackets(trust):
    """A class that is named between quotes is that of the same module too."""
    assert named_modules(["a=b", "env.problem._target_='other.Problem'"], trust) == ["mine", "other"]


@pytest.mark.parametrize("error", [ArgumentError("a: b"), PlanError(["a: b"]), ConfigError("a: b")])
def test_all_our_errors_are_one_line(error, capsys):
    with pytest.raises(SystemExit) as stop, reported(Path()):
        raise error
    assert (stop.value.code, capsys.readouterr().err) == (1, "error: a: b\n")


def test_a_bug_without_the_user_s_code_names_no_place(capsys, monkeypatch):
    monkeypatch.setattr("pirl_rl.places.LIBRARIES", (Path("/"),))
    with pytest.raises(SystemExit), reported(Path()):
        Reach1D().nothing  # noqa: B018
    first, *_, last = capsys.readouterr().err.splitlines()
    assert first == "Traceback (most recent call last):"
    assert last == "error: AttributeError: 'Reach1D' object has no attribute 'nothing'"


def test_other_jobs_of_a_sweep_go_on(capsys):
    raised_at = inspect.currentframe().f_lineno + 3
    for error in (ConfigError("a"), RuntimeError("a")):
        with pytest.raises(CompactHydraException), reported(Path(), one_of_many=True):
            raise error
    assert [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")] == [
        "error: a",
        f"error: RuntimeError: a ({__file__}, line {raised_at})",
    ]


def test_the_line_after_an_interrupt_can_be_pasted(cli):
    """It trusts the modules that the first command named."""
    own = (*QUICK, "trainer.log_every=20", "trainer.evaluate_every=0", "logger._target_=broken.Interrupts")
    code, text = cli(*own)
    assert code == 130
    _, _, line = text.strip().splitlines()[-1].partition("resume with: python -m pirl_rl.train ")
    assert shlex.split(line)[1] == "trust=[broken]"
    code, text = cli(*shlex.split(line))
    assert code == 0, text
