"""What commands say on the terminal: phases, the progress bar, and help."""

from __future__ import annotations

import importlib
import io
import re
import subprocess
import sys

import pytest
from tqdm import tqdm

from pirl_rl import progress
from pirl_rl.commands import catalogue

COMMANDS = ("train", "check", "evaluate", "certify", "tune", "export", "report", "compare", "sweeps", "suite")


@pytest.mark.parametrize("name", COMMANDS)
def test_all_help_has_one_style(name, capsys, monkeypatch):
    """A sentence, the line, and examples, none of which names another command."""
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    importlib.import_module(f"pirl_rl.{name}").main()
    text = capsys.readouterr().out
    first, blank, line, *_ = text.splitlines()
    assert first.endswith(".")
    assert blank == ""
    assert line.startswith(f"    python -m pirl_rl.{name} ")
    examples = text.partition("\nExamples:\n")[2].strip().splitlines()
    assert examples
    assert all(re.match(rf" *python -m pirl_rl\.{name} \S", example) for example in examples)
    assert max(map(len, text.splitlines())) <= 120


def test_the_list_of_commands_has_all_of_them():
    assert {re.findall(r"pirl_rl\.(\w+)", line)[0] for line, _ in catalogue.COMMANDS} == {*COMMANDS}


def test_the_bar_shows_fresh_losses_and_when_it_was_evaluated(monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(
        progress, "tqdm", lambda **settings: tqdm(**settings | {"disable": False, "file": shown, "mininterval": 0})
    )
    with progress.Progress(300, 0) as bar:
        bar.show(1, {"train_td_loss": 0.5, "value_mse": 0.25})
        bar.show(100, {"train_td_loss": 0.125})
        bar.show(101, {})
        assert bar.bar.postfix == "train_td_loss 0.125 | at update 1: value_mse 0.25"
        bar.show(200, {"train_td_loss": 0.0625, "value_mse": 0.03125})
        assert bar.bar.postfix == "train_td_loss 0.0625 | at update 200: value_mse 0.0312"


def test_a_phase_is_said_above_the_bar(capsys):
    progress.announce("checking the problem")
    assert capsys.readouterr().err == "checking the problem\n"


def test_a_command_speaks_before_its_imports(tmp_path):
    """Torch takes seconds to import; the first line must not wait for it."""
    child = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "pirl_rl.train"], stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert child.stderr is not None
    before = []
    for line in child.stderr:
        if line.startswith("loading"):
            break
        before.append(line.rpartition("|")[2].strip())
    child.kill()
    child.wait()
    assert "pirl_rl.progress" in before
    assert not {"torch", "torchrl", "hydra"} & {*before}
