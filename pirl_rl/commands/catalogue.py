"""The list of problems, choices and commands that `python -m pirl_rl` prints."""

from __future__ import annotations

import inspect
from pathlib import Path

from pirl_rl import problems
from pirl_rl.configuration import CONF

COMMANDS = (
    (
        "python -m pirl_rl.train +experiment=reach1d",
        "train; settings follow as key=value, and -m sweeps over several values",
    ),
    ("python -m pirl_rl.check my_module:MyProblem", "find mistakes in your own problem before it is trained"),
    ("python -m pirl_rl.train +experiment=own env.problem._target_=my_module.MyProblem", "train on your own problem"),
    ("python -m pirl_rl.train +experiment=zermelo method=grid", "solve a problem of up to three states on a grid"),
    ("python -m pirl_rl.train resume=RUN_DIR", "resume a run"),
    ("python -m pirl_rl.train +experiment=reach1d start=RUN_DIR", "start a new run with the networks of another run"),
    ("python -m pirl_rl.train +experiment=reach1d --cfg job", "show all settings"),
    ("python -m pirl_rl.evaluate run=RUN_DIR", "evaluate a run again, also with other samples or simulators"),
    (
        "python -m pirl_rl.certify run=RUN_DIR",
        "bound the success of a policy and the error of its V",
    ),
    ("python -m pirl_rl.report run=RUN_DIR", "draw the report of a run, or of several side by side"),
    ("python -m pirl_rl.tune +experiment=reach1d start=RUN_DIR", "continue a run in rounds that an advisor plans"),
    ("python -m pirl_rl.export run=RUN_DIR out=FOLDER", "copy the networks and the results of a run"),
    ("python -m pirl_rl.compare RUN_DIRS", "compare runs in one table and one figure"),
    ("python -m pirl_rl.sweeps DIR", "draw a table and a heat map of a sweep"),
    ("python -m pirl_rl.suite", "train the problems of the suite and compare them with known answers"),
)
GROUPS = {
    "experiment": "experiments, +experiment=NAME",
    "method": "methods, method=NAME",
    "collector": "collectors, collector=NAME",
    "logger": "loggers, logger=NAME",
    "advisor": "advisors of the outer loop, advisor=NAME",
}


def catalogue() -> str:
    """Problems, choices and commands, one line each."""
    known = [getattr(problems, name) for name in problems.__all__]
    parts = [_table("problems", [(problem.__name__, _first_line(problem)) for problem in known])]
    for group, title in GROUPS.items():
        rows = [(path.stem, _comment(path)) for path in choices(group)]
        parts.append(_table(title, rows))
    commands = "\n".join(f"  {command}\n      {meaning}" for command, meaning in COMMANDS)
    return "\n\n".join([*parts, f"commands\n{commands}"])


def choices(group: str) -> list[Path]:
    """The files of a group of the configuration, such as "experiment", in the order of their names."""
    return sorted((CONF / group).glob("*.yaml"))


def _table(title: str, rows: list[tuple[str, str]]) -> str:
    return "\n".join([title, *(f"  {name:<17} {meaning}".rstrip() for name, meaning in rows)])


def _first_line(cls: type) -> str:
    return (inspect.getdoc(cls) or "").partition("\n")[0]


def _comment(path: Path) -> str:
    """The first comment of a YAML file that is not a directive of Hydra."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return next((line[2:] for line in lines if line.startswith("# ") and "@package" not in line), "")
