"""What the checker found, in sentences that name the method, the place in the user's code and a point."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torch import Tensor

from pirl_rl.places import users_frames
from pirl_rl.problem import ReachAvoidProblem

Level = Literal["error", "warning", "note"]

MOST_COORDINATES = 8
"""The largest number of coordinates of a state that a sentence shows."""

OF_NUMPY = ("numpy()", "access data pointer")
"""What torch's errors about functions of numpy contain."""


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        level: "error" where training would fail or learn something else, "warning" where it probably would, "note" for
            a fact that is worth knowing.
        subject: the class and the method, such as "Boat.drift".
        message: a whole sentence with what was expected and what was got.
        place: the user's file and line, or empty where the source is not known.
        point: coordinates of a state at which it can be seen, or None.
    """

    level: Level
    subject: str
    message: str
    place: str = ""
    point: tuple[float, ...] | None = None

    def __str__(self) -> str:
        place = f" ({self.place})" if self.place else ""
        return f"{self.subject}{place}: {self.message}{'' if self.point is None else _example(self.point)}"


def found(
    problem: ReachAvoidProblem, level: Level, part: str, message: str, point: Tensor | None = None, place: str = ""
) -> Finding:
    """A finding about a method or an attribute of a problem, at a state (n,) if there is one to show."""
    where = place or source_of(problem, part)
    coordinates = None if point is None else tuple(point.tolist())
    return Finding(level, f"{type(problem).__name__}.{part}", message, where, coordinates)


def source_of(problem: ReachAvoidProblem, part: str) -> str:
    """The file and the line of a method or property, or else of the class; empty where there is no source."""
    method = inspect.getattr_static(type(problem), part, None)
    function = method.fget if isinstance(method, property) else method
    if inspect.isfunction(function):
        return f"{Path(function.__code__.co_filename).name}, line {function.__code__.co_firstlineno}"
    try:
        file, line = inspect.getsourcefile(type(problem)), inspect.getsourcelines(type(problem))[1]
    except (OSError, TypeError):  # a class of an interactive session
        return ""
    return f"{Path(file or '').name}, line {line}"


def raised_in(error: BaseException) -> str:
    """The file and the line of the user's code in which an exception was raised; empty where it is not known."""
    frames = users_frames(error)
    return f"{Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else ""


def method_that_raised(error: BaseException, check: str) -> str:
    """The name of the problem's method that was called when an exception was raised.

    Where its result led to the exception, a check that has the name of a method, such as "planes", is about this one.
    Where nothing is known it is the drift.
    """
    names = [*(frame.name for frame in users_frames(error)), check]
    return next((name for name in names if hasattr(ReachAvoidProblem, name)), "drift")


def hint(error: str) -> str:
    """A remark on an error of torch that a function of numpy has caused, else nothing.

    What torch itself advises there, `detach`, would lose the derivatives.
    """
    if not any(sign in error for sign in OF_NUMPY):
        return ""
    return " (physics and levels need functions of torch, such as torch.sin and torch.maximum, and not those of numpy)"


def _example(point: tuple[float, ...]) -> str:
    """A sentence with a state, of which it shows the first `MOST_COORDINATES` coordinates."""
    numbers = ", ".join(f"{coordinate:.6g}" for coordinate in point[:MOST_COORDINATES])
    rest = f", ... ({len(point)} coordinates)" if len(point) > MOST_COORDINATES else ""
    return f" For example at x = [{numbers}{rest}]."


def report(findings: Iterable[Finding], levels: Iterable[Level] = ("error", "warning", "note")) -> str:
    """The findings of the given levels, one line each, the errors first."""
    order, kept = {"error": 0, "warning": 1, "note": 2}, {*levels}
    chosen = sorted((finding for finding in findings if finding.level in kept), key=lambda f: order[f.level])
    return "\n".join(f"{finding.level:<8} {finding}" for finding in chosen)
