"""Names of coordinates such as "v_x (m/s)" as HTML and as MathML."""

from __future__ import annotations

import re
import unicodedata

from markupsafe import Markup, escape

from pirl_rl.problem import ReachAvoidProblem

LETTERS = "alpha|beta|gamma|delta|epsilon|zeta|eta|theta|kappa|lambda|mu|nu|xi|pi|rho|sigma|tau|phi|chi|psi|omega"
"""The names of Greek letters that are written as letters."""

GREEK = re.compile(rf"(?<![A-Za-z])({LETTERS})(?![A-Za-z])")
LOWERED, RAISED = re.compile(r"_\{?(\w+)\}?"), re.compile(r"\^\{?(-?\w+)\}?")
SYMBOL = re.compile(r"(\w)(?:_(\w+))?('*)")
"""A letter with an index and primes, after Greek letters were replaced."""


def state_names(problem: ReachAvoidProblem) -> list[str]:
    """The names of the coordinates of the state, those of the problem or x_1, x_2 and so on."""
    return _names(problem.state_names, "x", problem.states.dim)


def control_names(problem: ReachAvoidProblem) -> list[str]:
    """The names of the coordinates of the control, those of the problem or u_1, u_2 and so on."""
    return _names(problem.control_names, "u", problem.controls.dim)


def _names(given, letter: str, count: int) -> list[str]:
    return list(given) or ([letter] if count == 1 else [f"{letter}_{i + 1}" for i in range(count)])


def split_unit(name: str) -> tuple[str, str]:
    """The symbol and the unit of a name; the unit is empty where the name has none."""
    found = re.fullmatch(r"(.*?)\s*\(([^()]*)\)\s*", name)
    return (found[1], found[2]) if found else (name, "")


def as_html(name: str) -> Markup:
    """A name with Greek letters, indices and powers; everything else is escaped."""
    text = str(escape(GREEK.sub(_letter, name.replace("$", "").replace("'", "′"))))
    return Markup(RAISED.sub(r"<sup>\1</sup>", LOWERED.sub(r"<sub>\1</sub>", text)))


def as_mathml(symbol: str) -> Markup:
    """A symbol as an identifier of MathML, or as text where it is no letter with an index."""
    plain = GREEK.sub(_letter, symbol)
    found = SYMBOL.fullmatch(plain)
    if not found:
        return Markup("<mtext>{}</mtext>").format(plain)
    letter, index, primes = found.groups()
    result = Markup("<mi>{}</mi>").format(letter)
    if index:
        tag = "mn" if index.isdigit() else "mi"
        result = Markup(f"<msub>{{}}<{tag}>{{}}</{tag}></msub>").format(result, index)
    if primes:
        result = Markup("<mrow>{}<mo lspace='0' rspace='0'>{}</mo></mrow>").format(result, "′" * len(primes))
    return result


def _letter(found: re.Match[str]) -> str:
    name = found[1].replace("lambda", "lamda")  # its name in Unicode
    return unicodedata.lookup(f"GREEK SMALL LETTER {name.upper()}")
