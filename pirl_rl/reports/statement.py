"""A problem as a control engineer states it: equations, boxes with units, noise, sets and objective."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.reports.equations import MOST_ROWS, equations
from pirl_rl.reports.names import as_html, control_names, split_unit, state_names
from pirl_rl.reports.outlines import outlines
from pirl_rl.sets import Box, Plane
from pirl_rl.structure import noise_channels


@dataclass(frozen=True)
class Statement:
    """A problem in words, formulas and pictures.

    Attributes:
        name: the class.
        module: its module.
        text: the docstring of the class.
        notes: the docstring of its module, which for shipped problems names coordinates and source.
        horizon: T in s.
        objective: "reach-avoid" or "invariance".
        payoff: the class of the payoff and its width.
        counts: the numbers of states, controls and noise channels.
        states, controls: name, unit, lower and upper bound of each coordinate, and whether it is periodic.
        equations: a line of MathML for each coordinate.
        shown: the number of coordinates, of the state and of the control, that are written out at most.
        sets: pictures of the sets.
        sources: names of the classes that define the problem, with their code.
    """

    name: str
    module: str
    text: str
    notes: str
    horizon: float
    objective: str
    payoff: tuple[str, float]
    counts: tuple[int, int, int]
    states: list[dict[str, Any]]
    controls: list[dict[str, Any]]
    equations: list[Markup]
    shown: int
    sets: list[dict[str, Any]]
    sources: list[tuple[str, str]]

    @classmethod
    def of(cls, problem: ReachAvoidProblem, planes: Mapping[str, Plane]) -> Statement:
        kind, states, controls = type(problem), problem.states, problem.controls
        return cls(
            name=kind.__name__,
            module=kind.__module__,
            text=inspect.cleandoc(kind.__doc__ or ""),
            notes=_notes(kind),
            horizon=problem.horizon,
            objective=problem.objective,
            payoff=(type(problem.payoff).__name__, problem.payoff.epsilon),
            counts=(states.dim, controls.dim, noise_channels(problem)),
            states=_table(state_names(problem), states),
            controls=_table(control_names(problem), controls),
            equations=equations(problem),
            shown=MOST_ROWS,
            sets=outlines(problem, planes),
            sources=_sources(kind),
        )


def _table(names: list[str], box: Box) -> list[dict[str, Any]]:
    rows = zip(names, box.low, box.high, strict=True)
    return [
        {
            "symbol": as_html(split_unit(name)[0]),
            "unit": as_html(split_unit(name)[1]),
            "low": low,
            "high": high,
            "periodic": axis in box.periodic,
        }
        for axis, (name, low, high) in enumerate(rows)
    ][:MOST_ROWS]


def _notes(kind: type) -> str:
    """The docstring of the module of a class, unless the class was defined in a script, whose docstring is its own."""
    text = None if kind.__module__ == "__main__" else getattr(inspect.getmodule(kind), "__doc__", None)
    return inspect.cleandoc(text or "")


def _sources(kind: type) -> list[tuple[str, str]]:
    """The code of the classes below `ReachAvoidProblem`, as far as their files can be read."""
    found = []
    for cls in kind.__mro__:
        if issubclass(cls, ReachAvoidProblem) and cls is not ReachAvoidProblem:
            try:
                found.append((cls.__qualname__, textwrap.dedent(inspect.getsource(cls))))
            except (OSError, TypeError):
                continue
    return found
