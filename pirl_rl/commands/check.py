"""Check a problem before it is trained.

    python -m pirl_rl.check my_module:MyProblem [dt=0.01] [substeps=4] [key=value ...]

Finds mistakes in the methods of a problem, its sets and its units, in seconds, and names the method, the line and a
state at which each can be seen. Without an error it also prints the time steps with which the problem would be
simulated. Ends with exit code 1 where there is an error. Training starts with the same check, unless it is given
check=false.

    my_module:MyProblem  the class, in a module that Python finds from the current directory; a dot in place of the
                         colon will do, too
    dt                   the control step with which the problem will be simulated, in s; by default the proposed one
    substeps             the number of integration steps in a control step; by default the proposed number
    key=value            any other setting is an argument of the class

Examples:
    python -m pirl_rl.check my_module:MyProblem
    python -m pirl_rl.check pirl_rl.problems:HalfSpace dim=30
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from pirl_rl.checking import Finding, check, examine, report
from pirl_rl.commands.console import program, read_settings, reported
from pirl_rl.errors import ConfigError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.time_steps import propose_time_steps


@program
def main(arguments: Sequence[str]) -> None:
    with reported(Path()):
        named = [text for text in arguments if "=" not in text]
        if len(named) != 1:
            raise ConfigError(
                "expected one argument without a sign of equality, the class of a problem, as in python -m "
                f"pirl_rl.check my_module:MyProblem, got {' '.join(arguments) or 'nothing'}"
            )
        settings = read_settings([text for text in arguments if "=" in text])
        steps = {name: settings.pop(name) for name in ("dt", "substeps") if name in settings}
        problem = _problem(named[0], settings)
        started = time.perf_counter()
        findings = examine(problem, **steps)
        failed = any(finding.level == "error" for finding in findings)
        time_steps = "" if failed else propose_time_steps(problem, **steps).reason
    print(_outcome(problem, findings, time.perf_counter() - started))
    if text := report(findings):
        print(text)
    if failed:
        sys.exit(1)
    print(f"time     {time_steps}")


def check_before_training(config: DictConfig, problem: ReachAvoidProblem) -> None:
    """Print the warnings about a problem, with the time steps of a configuration.

    Raises:
        ProblemError: if the problem has errors; the message lists them.
    """
    # The word `auto` leaves a step to the package, and an environment of one's own may have no such setting.
    dt, substeps = (None if isinstance(value := config.env.get(name), str) else value for name in ("dt", "substeps"))
    crossing = config.env.get("crossing", Simulator.crossing)
    if warnings := report(check(problem, dt, substeps, crossing), ["warning"]):
        print(warnings, flush=True)


def _problem(named: str, settings: dict[str, Any]) -> ReachAvoidProblem:
    """The problem `my_module:MyProblem` or `my_module.MyProblem`, with arguments of its class.

    Raises:
        ConfigError: there is no such module or class, or it does not take the arguments.
    """
    module, _, name = named.rpartition(":" if ":" in named else ".")
    if not module or not name:
        raise ConfigError(f"expected my_module:MyProblem, got {named!r}")
    try:
        # Another error during the import is a bug of the module and is left unchanged.
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0] and error.name != module:
            raise
        raise ConfigError(f"{named}: expected a module that Python finds from here, got no module {module!r}") from None
    if not hasattr(found, name):
        raise ConfigError(f"{named}: expected my_module:MyProblem, but {module} has no class {name!r}")
    kind = getattr(found, name)
    if not (isinstance(kind, type) and issubclass(kind, ReachAvoidProblem)):
        raise ConfigError(f"{named}: expected a subclass of pirl_rl.ReachAvoidProblem, got {kind!r}")
    try:
        return kind(**settings)
    except TypeError as error:
        raise ConfigError(f"{named}: {error}") from None


def _outcome(problem: ReachAvoidProblem, findings: list[Finding], seconds: float) -> str:
    counts = [(level, sum(finding.level == level for finding in findings)) for level in ("error", "warning", "note")]
    words = ", ".join(f"{count} {level}{'s' * (count != 1)}" for level, count in counts)
    return f"{type(problem).__name__}: {words} in {seconds:.1f} s"
