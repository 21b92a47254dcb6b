"""The floors of the package: the contract of `make lint` holds, and each wall is red when it is broken."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CONTRACTS = {
    contract["id"]: contract
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
}
LINE = "building | configuration"
"""The lowest floor that knows OmegaConf."""


def checked(root: Path) -> subprocess.CompletedProcess[str]:
    """The linter's verdict on the package below a folder."""
    code = "import sys; from importlinter.cli import lint_imports_command; lint_imports_command()"
    arguments = ["--no-logo", "--no-cache", "--config", str(root / "pyproject.toml")]
    environment = {**os.environ, "PYTHONPATH": str(root), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=root, env=environment, capture_output=True, text=True, check=False
    )


def test_the_floors_hold():
    done = checked(ROOT)
    assert done.returncode == 0, done.stdout
    assert f"Contracts: {len(CONTRACTS)} kept, 0 broken." in done.stdout


def test_every_module_below_the_line_is_named_by_it():
    layers = CONTRACTS["floors"]["layers"]
    below = [name.strip() for layer in layers[layers.index(LINE) + 1 :] for name in layer.replace(":", "|").split("|")]
    assert sorted(CONTRACTS["line"]["source_modules"]) == sorted(f"pirl_rl.{name}" for name in below)


@pytest.mark.parametrize(
    ("module", "line", "broken"),
    [
        ("simulator", "from pirl_rl.problems.drift.problem import VehicleDrift", "floors"),
        ("sampling/collocation", "from pirl_rl.problems.drift import vehicle", "floors"),
        ("evaluation/success", "from pirl_rl.runs.load import load_run", "floors"),
        ("actor_rules/q", "from pirl_rl.losses import PIRLLoss", "floors"),
        ("outer_loop/loop", "from pirl_rl.commands.console import reported", "floors"),
        ("solution", "import hydra", "line"),
        ("run_directory", "from omegaconf import OmegaConf", "line"),
        ("figures/training", "import omegaconf", "line"),
        ("runs/load", "from hydra import compose", "hydra"),
        ("problems/reach1d", "import hydra", "hydra"),
    ],
)
def test_each_wall_is_red_when_it_is_broken(module, line, broken, tmp_path):
    """Other walls may be red beside it: what imports runs reaches OmegaConf, too."""
    shutil.copytree(ROOT / "pirl_rl", tmp_path / "pirl_rl", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copyfile(ROOT / "pyproject.toml", tmp_path / "pyproject.toml")
    path = tmp_path / "pirl_rl" / f"{module}.py"
    path.write_text(f"{path.read_text()}\n{line}\n")
    done = checked(tmp_path)
    assert done.returncode != 0
    verdicts = [text for text in done.stdout.splitlines() if text.endswith((" KEPT", " BROKEN"))]
    assert verdicts[list(CONTRACTS).index(broken)].endswith("BROKEN"), done.stdout
