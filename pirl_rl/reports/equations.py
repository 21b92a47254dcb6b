"""The SDE of a problem, one line of MathML for each coordinate, found by probing the drift and the diffusion.

The functions of a problem are code. At random states and controls their slopes tell which rows are linear, with which
coefficients, and on which coordinates the others depend.
"""

from __future__ import annotations

import torch
from markupsafe import Markup
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.reports.names import as_mathml, control_names, split_unit, state_names

POINTS = 64
"""The number of random states and controls, in the inner 98% of their boxes."""

STEP = 1e-3
"""Half of the distance of central differences, as a share of half of the box's width."""

SAME = 1e-7
"""The relative difference up to which slopes count as equal. Differences in double precision have errors of 1e-12."""

SPACE = Markup("<mspace width='.15em'/>")
TIME, NOISE = SPACE + Markup("<mi>d</mi><mi>t</mi>"), Markup("<mi>d</mi><mi>W</mi>")

STATE_AND_CONTROL = Markup("<mi>x</mi><mo>,</mo><mi>u</mi>")

TINY = 1e-300
"""What the size of a drift that is 0 counts as."""

MOST_TERMS = 8
"""The largest number of coordinates of a row that are named."""

MOST_ROWS = 12
"""The largest number of coordinates whose equations are written."""


def equations(problem: ReachAvoidProblem) -> list[Markup]:
    """The equations of the first `MOST_ROWS` coordinates."""
    rng = torch.Generator().manual_seed(0)
    x, u = (0.98 * (2 * torch.rand(POINTS, box.dim, generator=rng, dtype=torch.float64) - 1) for box in _boxes(problem))
    x, u = problem.states.denormalize(x), problem.controls.denormalize(u)
    drift, slopes = problem.drift(x, u), _slopes(problem, x, u)
    sigma = problem.diffusion(x, u)
    symbols = [as_mathml(split_unit(name)[0]) for name in [*state_names(problem), *control_names(problem)]]
    rows = []
    for i in range(min(problem.states.dim, MOST_ROWS)):
        moved = _drift_terms(i, drift[:, i], slopes[:, i], torch.cat([x, u], -1), symbols)
        shaken = _noise(i, sigma[:, i], first=not moved)
        rows.append(Markup("<mi>d</mi>{}<mo>=</mo>{}").format(symbols[i], moved + shaken or Markup("<mn>0</mn>")))
    return rows


def _boxes(problem: ReachAvoidProblem):
    return problem.states, problem.controls


def _slopes(problem: ReachAvoidProblem, x: Tensor, u: Tensor) -> Tensor:
    """Central differences (P, n, n + m) of the drift in the coordinates of state and control."""
    columns = []
    for box, which in zip(_boxes(problem), (0, 1), strict=True):
        half = box.center_and_half_width(x)[1]
        for j in range(box.dim):
            move = torch.zeros(box.dim, dtype=x.dtype)
            move[j] = STEP * half[j]
            up, down = ((x + s * move, u) if which == 0 else (x, u + s * move) for s in (1, -1))
            columns.append((problem.drift(*up) - problem.drift(*down)) / (2 * move[j]))
    return torch.stack(columns, -1)


def _drift_terms(i: int, drift: Tensor, slopes: Tensor, z: Tensor, symbols: list[Markup]) -> Markup:
    """The term of dt of one coordinate, from its drift (P,), slopes (P, n + m) and the points z (P, n + m)."""
    size, slope = z.abs().amax(0), slopes.mean(0)
    scale = max(float(drift.abs().max()), float((slopes.abs().amax(0) * size).max()), TINY)
    depends = ((slopes.abs().amax(0) * size) > SAME * scale).tolist()
    named = [symbol for symbol, has in zip(symbols, depends, strict=True) if has]
    rest = drift - z @ slope
    bends = float(((slopes - slope).abs().amax(0) * size).max()), float((rest - rest.mean()).abs().max())
    if max(bends) > SAME * scale or len(named) > MOST_TERMS:
        arguments = Markup("<mo>,</mo>").join(named) if len(named) <= MOST_TERMS else STATE_AND_CONTROL
        return Markup("<msub><mi>f</mi><mn>{}</mn></msub>").format(i + 1) + _bracketed(arguments) + TIME
    terms = [(value, symbol) for value, symbol, has in zip(slope.tolist(), symbols, depends, strict=True) if has]
    offset = float(rest.mean())
    if abs(offset) > SAME * scale:
        terms.append((offset, Markup("")))
    total = Markup("").join(_term(*term, first=k == 0) for k, term in enumerate(terms))
    return (_bracketed(total) if len(terms) > 1 else total) + TIME if terms else Markup("")


def _noise(i: int, sigma: Tensor, first: bool) -> Markup:
    """The terms of dW of one coordinate, from its row (P, w) of the diffusion."""
    if not bool(sigma.any()):
        return Markup("")
    if float((sigma - sigma[0]).abs().max()) > SAME * float(sigma.abs().max()):
        plus = Markup("" if first else "<mo>+</mo>")
        function = Markup("<msub><mi>σ</mi><mn>{}</mn></msub>").format(i + 1) + _bracketed(STATE_AND_CONTROL)
        return plus + function + SPACE + NOISE
    numbered = Markup("<mi>d</mi><msub><mi>W</mi><mn>{}</mn></msub>") if sigma.shape[-1] > 1 else NOISE
    present = [(value, numbered.format(k + 1)) for k, value in enumerate(sigma[0].tolist()) if value]
    return Markup("").join(_term(value, SPACE + dw, first and k == 0) for k, (value, dw) in enumerate(present))


def _bracketed(inside: Markup) -> Markup:
    return Markup("<mo stretchy='false'>(</mo>{}<mo stretchy='false'>)</mo>").format(inside)


def _term(value: float, symbol: Markup, first: bool) -> Markup:
    """A coefficient, of four digits and left out where it is 1, before a symbol, with its sign."""
    sign = "−" if value < 0 else "" if first else "+"
    digits, _, power = f"{abs(value):.4g}".partition("e")
    number = Markup("<mn>{}</mn>").format(digits) if digits != "1" or power or not symbol else Markup("")
    if power:
        number += Markup("<mo>·</mo><msup><mn>10</mn><mn>{}</mn></msup>").format(int(power))
    return (Markup("<mo>{}</mo>").format(sign) if sign else Markup("")) + number + symbol
