"""The checker, which finds mistakes in a problem before anything is trained.

`check` goes through groups of checks, each of which relies on those before it, and stops after the first group that
finds an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

from pirl_rl.checking import answers, dynamics, level_sets, methods
from pirl_rl.checking.findings import Finding, found, hint, method_that_raised, raised_in, report
from pirl_rl.checking.samples import Samples
from pirl_rl.errors import ArgumentError, ProblemError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box
from pirl_rl.simulator import Crossing
from pirl_rl.time_steps import check_time_steps

__all__ = ["Finding", "check", "examine", "report"]

Check = Callable[[Samples], Iterable[Finding]]


def check(
    problem: ReachAvoidProblem, dt: float | None = None, substeps: int | None = None, crossing: Crossing = "bridge"
) -> list[Finding]:
    """The warnings and notes of `examine`.

    Raises:
        ProblemError: if the problem has errors; the message lists them.
    """
    findings = examine(problem, dt, substeps, crossing)
    if errors := report(findings, ["error"]):
        raise ProblemError(errors.removeprefix("error").strip())  # the commands print `error:` before a message
    return findings


def examine(
    problem: ReachAvoidProblem, dt: float | None = None, substeps: int | None = None, crossing: Crossing = "bridge"
) -> list[Finding]:
    """All findings about a problem.

    Args:
        problem: the problem.
        dt: the control step with which it will be simulated, in s; by default the one that is proposed.
        substeps: the number of integration steps in a control step; by default the proposed number.
        crossing: the rule with which it will be simulated, see `pirl_rl.simulator`.

    Raises:
        ArgumentError: `problem` is no problem, a time step is out of range, or `crossing` is unknown.
    """
    if not isinstance(problem, ReachAvoidProblem):
        raise ArgumentError(f"problem: expected an object of a subclass of ReachAvoidProblem, got {problem!r}")
    findings = [*attributes(problem)]
    if findings:
        return findings
    check_time_steps(problem, dt, substeps, crossing)
    samples = Samples(problem)
    groups: list[list[Check]] = [
        [methods.calls],
        [methods.side_effects],
        [methods.shapes],
        [methods.batches],
        [methods.arrangements],
        [methods.finite, methods.derivatives],
        [level_sets.agreement, level_sets.sizes, level_sets.overlap, level_sets.places],
        [
            level_sets.slopes,
            dynamics.controls,
            dynamics.noise,
            dynamics.units_of_time,
            dynamics.angles,
            lambda samples: dynamics.steps(samples, dt, substeps, crossing),
            answers.exact_value,
            answers.optimal_control,
            answers.planes,
        ],
    ]
    for group in groups:
        for one in group:
            findings += _guarded(one, samples)
        if any(finding.level == "error" for finding in findings):
            break
    return findings


def attributes(problem: ReachAvoidProblem) -> Iterator[Finding]:
    """The horizon and the boxes must be there before any method can be called."""
    horizon = getattr(problem, "horizon", None)
    if not isinstance(horizon, (int, float)) or not 0 < horizon < math.inf:
        message = f"expected a finite number of seconds above 0, an int or a float, got {horizon!r}."
        yield found(problem, "error", "horizon", message)
    for name in ("states", "controls"):
        box = getattr(problem, name, None)
        if not isinstance(box, Box):
            yield found(problem, "error", name, f"expected a pirl_rl.Box, got {box!r}.")
        elif name == "controls" and box.periodic:
            yield found(problem, "error", name, f"only states may be periodic, got {box}.")
    if isinstance(problem.payoff, type) or not callable(problem.payoff) or not hasattr(problem.payoff, "epsilon"):
        yield found(problem, "error", "payoff", f"expected one of pirl_rl.payoffs, got {problem.payoff!r}.")
    if problem.objective not in ("reach-avoid", "invariance"):
        message = f"expected 'reach-avoid' or 'invariance', got {problem.objective!r}."
        yield found(problem, "error", "objective", message)


def _guarded(one: Check, samples: Samples) -> list[Finding]:
    """The findings of a check; an exception of a method of the problem is a finding too."""
    try:
        return [*one(samples)]
    except Exception as error:
        got = f"{type(error).__name__}: {error}".partition("\n")[0]
        message = f"expected a result at every state, got {got}{hint(got)}."
        method = method_that_raised(error, one.__name__)
        return [found(samples.problem, "error", method, message, place=raised_in(error))]
