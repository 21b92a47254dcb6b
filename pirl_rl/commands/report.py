"""Draw the report of a run, or of several side by side, on one HTML page that needs no network.

    python -m pirl_rl.report run=RUN_DIR [out=FILE] [trust=[my_module]]
    python -m pirl_rl.report run=RUN_DIR run=RUN_DIR out=FILE

The page has the verdict, the problem, V and the policy with sliders, paths, certificates, the training, all metrics
with their meanings, and how the run was made. Each run ends with it (report=false leaves it out), and `evaluate` and
`certify` draw it again.

    run    the directory of a run; several, or a list such as run=[A,B], are shown side by side
    out    the file; by default report.html in the directory of the run, if there is one run
    trust  modules of your own that the runs may import, such as trust=[my_module]

Examples:
    python -m pirl_rl.report run=runs/reach1d/2026-01-31_12-00-00-0
    python -m pirl_rl.report run=models/drift out=drift.html
    python -m pirl_rl.report run=[runs/suite/dubins/0,runs/suite/dubins/1] out=dubins.html
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pirl_rl.building import trusted_modules
from pirl_rl.commands.console import program, reported
from pirl_rl.configuration import PACKAGE
from pirl_rl.errors import ConfigError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.progress import announce
from pirl_rl.reports import write_report
from pirl_rl.run_directory import RunDirectory

KEYS = ("run", "out", "trust")


@program
def main(arguments: Sequence[str]) -> None:
    with reported(Path()):
        given: dict[str, list[str]] = {key: [] for key in KEYS}
        for text in arguments:
            key, equals, value = text.partition("=")
            if key not in KEYS or not equals:
                raise ConfigError(f"{text}: expected key=value with a key out of {', '.join(KEYS)}")
            given[key] += _listed(value) if key == "run" else [value]
        folders, out = [Path(name) for name in given["run"]], [Path(name) for name in given["out"]]
        if not folders:
            raise ConfigError("run: expected run=RUN_DIR, the directory of a run")
        if len(folders) > 1 and not out:
            raise ConfigError(f"out: expected out=FILE for the report of {len(folders)} runs")
        announce("drawing the report")
        path = write_report(
            folders, out[-1] if out else RunDirectory(folders[0]).report, trusted_modules(",".join(given["trust"]))
        )
    print(f"written  {path}")


def draw_again(folder: Path, trust: Sequence[str] = (), problem: ReachAvoidProblem | None = None) -> None:
    """Draw the report at the end of another command, which goes on with one sentence on stderr if this fails.

    Args:
        folder: the run directory.
        trust: modules outside the package that its configuration may name.
        problem: replaces `env.problem`, for a run that was trained on an object.
    """
    announce("drawing the report")
    modules = [name for name in dict.fromkeys(trust) if name != PACKAGE.name]
    try:
        path = write_report([folder], RunDirectory(folder).report, modules, problem)
    except Exception as error:
        reason = str(error).partition("\n")[0]
        print(f"warning: the report was not drawn, {type(error).__name__}: {reason}", file=sys.stderr, flush=True)
    else:
        print(f"report   {path}")


def _listed(text: str) -> list[str]:
    """The entries of a list such as [a,b], or of a single value."""
    inner = text.removeprefix("[").removesuffix("]")
    return [entry.strip() for entry in inner.split(",") if entry.strip()] if inner != text else [text]
