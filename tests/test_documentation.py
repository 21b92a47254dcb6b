"""README and docs: their length, the files that they name, and the commands that they show."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from pirl_rl.commands.composition import compose
from pirl_rl.commands.methods import check_method

ROOT = Path(__file__).parent.parent
TEXTS = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "models").glob("*/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
LINK = re.compile(r"\]\(((?!\w+:|#)[^)#\s]+)")
NAMED = re.compile(r"`((?:pirl_rl|conf|benchmarks|docs|models|notebooks|tests)/[\w/.]*)`")


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))

PRINTED = r"""
python() { [[ $2 != pirl_rl.@(train|tune) ]] || { printf '%q ' python "$@"; echo; }; }
pip() { :; }
make() { :; }
"""
"""In place of running a shell block, its training commands are printed as the shell expands them, one a line."""


def commands(text: str) -> list[str]:
    """The commands of a text's shell blocks that train or tune, loops and functions of the shell expanded."""
    blocks = [block for block in re.findall(r"```bash\n(.*?)```", text, re.DOTALL) if "pirl_rl.t" in block]
    script = "\n".join(["shopt -s extglob", PRINTED, *blocks])
    return subprocess.run(["bash", "-eu", "-c", script], capture_output=True, text=True, check=True).stdout.splitlines()


COMMANDS = sorted({line for path in TEXTS for line in commands(path.read_text())})


def ids(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


@pytest.mark.parametrize("path", [*TEXTS, *NOTEBOOKS], ids=ids)
def test_every_link_leads_to_a_file(path):
    missing = [link for link in LINK.findall(path.read_text()) if not (path.parent / link).is_file()]
    assert not missing


@pytest.mark.parametrize("path", TEXTS, ids=ids)
def test_every_file_that_is_named_exists(path):
    missing = [name for name in NAMED.findall(path.read_text()) if not (ROOT / name).exists()]
    assert not missing


@pytest.mark.parametrize("path", TEXTS, ids=ids)
def test_every_fence_is_closed(path):
    """An open one would swallow the rest of the page."""
    assert path.read_text().count("\n```") % 2 == 0


@pytest.mark.parametrize("line", [line for line in COMMANDS if " resume=" not in line])
def test_every_command_composes(line):
    """Hydra knows all groups and keys of a command, and the experiment works with the method; of a sweep the first
    combination is taken."""
    _, _, module, *words = shlex.split(line)
    parser = OverridesParser.create()
    overrides = []
    for word in words:
        if word == "-m" or word.startswith("--"):
            continue
        override = parser.parse_override(word)
        if override.is_sweep_override():
            word = f"{word.partition('=')[0]}={next(override.sweep_string_iterator())}"
        if not word.startswith("hydra"):
            overrides.append(word)
    config = compose(module.rpartition(".")[2], overrides)
    check_method(config, overrides)
    OmegaConf.to_container(config, resolve=True)


def test_there_are_commands():
    assert len(COMMANDS) > 30


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    line = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", str(ROOT / "docs"), str(tmp_path / "html")]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "html" / "reference.html").is_file()
