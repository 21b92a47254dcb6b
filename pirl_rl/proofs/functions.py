"""Enclosures of the functions of torch that compute."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pirl_rl.errors import ProofError
from pirl_rl.proofs.affine import FUNCTIONS, Affine, Number
from pirl_rl.proofs.structure import unbind, unsqueeze

LEAST = 1e-12
"""An argument of a root, a logarithm or a reciprocal must be above this in the whole box."""


def _bell(z: Tensor) -> Tensor:
    """The slope of the sigmoid. As y (1 - y) it would have no correct digits where y is rounded to 1."""
    return torch.sigmoid(z) * torch.sigmoid(-z)


def _tanh(z: Affine) -> Affine:
    """|tanh''| = 2 |tanh| (1 - tanh^2) rises up to |z| = 0.6585, where it is 0.7699, and falls beyond."""
    steepest = math.atanh(1 / math.sqrt(3))

    def curvature(low: Tensor, high: Tensor) -> Tensor:
        least, most = _distances(low, high)
        worst = least.clamp(min=steepest).where(most > steepest, most)
        return 8 * torch.tanh(worst) * _bell(2 * worst) * (1 + 1e-12)

    return z.smooth(torch.tanh, lambda c: 4 * _bell(2 * c), curvature, True)


def _sigmoid(z: Affine) -> Affine:
    return z.smooth(torch.sigmoid, _bell, _constant(1 / (6 * math.sqrt(3))), True)


def _silu(z: Affine) -> Affine:
    """z / (1 + exp(-z)), whose second derivative is even.

    It falls from 0.5 at z = 0 to 0 at |z| = 2.3994 and on to -0.0369 at |z| = 3.4358, and rises towards 0 from there.
    """

    def curvature(low: Tensor, high: Tensor) -> Tensor:
        least, _ = _distances(low, high)
        size = (_bell(least) * (2 - least * torch.tanh(least / 2))).abs()
        return torch.where(least < 3.44, size.clamp(min=0.04), size) * (1 + 1e-12)

    def slope(c: Tensor) -> Tensor:
        return torch.sigmoid(c) + c * _bell(c)

    return z.smooth(torch.nn.functional.silu, slope, curvature)


def _softplus(z: Affine, beta: float = 1.0, threshold: float = 20.0) -> Affine:
    if beta != 1.0:
        raise ProofError(f"softplus: expected beta = 1, got {beta}")
    # Beyond its threshold torch returns z itself, which is wrong by at most exp(-threshold).
    result = z.smooth(torch.nn.functional.softplus, torch.sigmoid, _constant(0.25), True)
    return Affine(result.centre, result.slopes, result.radius + math.exp(-threshold))


def _sqrt(z: Affine) -> Affine:
    _require("sqrt", z.low)
    return z.smooth(torch.sqrt, lambda c: 0.5 / c.sqrt(), lambda low, high: 0.25 * low.pow(-1.5), True)


def _exp(z: Affine) -> Affine:
    return z.smooth(torch.exp, torch.exp, lambda low, high: high.exp(), True)


def _log(z: Affine) -> Affine:
    _require("log", z.low)
    return z.smooth(torch.log, torch.reciprocal, lambda low, high: low.pow(-2), True)


def _tan(z: Affine) -> Affine:
    largest = z.magnitude
    if not bool((largest < math.pi / 2 - 1e-6).all()):
        raise ProofError("tan: its argument reaches pi/2 in a box")

    def curvature(low: Tensor, high: Tensor) -> Tensor:
        tangent = torch.maximum(low.abs(), high.abs()).tan()
        return 2 * tangent * (1 + tangent.square())

    return z.smooth(torch.tan, lambda c: 1 + c.tan().square(), curvature, True)


def _atan(z: Affine) -> Affine:
    return z.smooth(torch.atan, lambda c: 1 / (1 + c.square()), _constant(3 * math.sqrt(3) / 8), True)


def _sin(z: Affine) -> Affine:
    return _bounded(z.smooth(torch.sin, torch.cos, _constant(1.0)))


def _cos(z: Affine) -> Affine:
    return _bounded(z.smooth(torch.cos, lambda c: -c.sin(), _constant(1.0)))


def _bounded(result: Affine) -> Affine:
    """Forms of values in [-1, 1]; wide ones become that interval."""
    zeros, ones = torch.zeros_like(result.centre), torch.ones_like(result.radius)
    return result.where(result.spread <= 1, Affine(zeros, torch.zeros_like(result.slopes), ones))


def _square(z: Affine) -> Affine:
    return z.smooth(torch.square, lambda c: 2 * c, _constant(2.0))


def _reciprocal(z: Affine) -> Affine:
    """1/z of forms with one sign; that of negative ones is -1/(-z)."""
    sign = z.centre.sign()
    positive = z * sign
    _require("division", positive.low)
    result = positive.smooth(torch.reciprocal, lambda c: -1 / c.square(), lambda low, high: 2 * low.pow(-3))
    return result * sign


def _abs(z: Affine) -> Affine:
    """|z|; where z changes its sign, the best line between the chord of |z| and a parallel through its corner."""
    low, high = z.low, z.high
    width = (high - low).clamp(min=1e-300)
    line = ((high.abs() - low.abs()) / width).clamp(-1, 1)
    line = torch.where(low >= 0, 1.0, torch.where(high <= 0, -1.0, line))
    gap = torch.where((low < 0) & (high > 0), torch.maximum((1 - line) * high, (1 + line) * -low) / 2, 0.0)
    tilted = z * line
    return Affine(tilted.centre + gap, tilted.slopes, tilted.radius + gap * (1 + 1e-12))


def _greater(a: Affine | Number, b: Affine | Number) -> Affine:
    """Whether a > b, or a >= b: 1 where it holds in a whole box, 0 where it holds nowhere, and else all of [0, 1]."""
    difference = Affine.of(a, b) - b  # type: ignore[arg-type]
    holds, fails = difference.low > 0, difference.high < 0
    centre = torch.where(holds, 1.0, torch.where(fails, 0.0, 0.5)).double()
    radius = torch.where(holds | fails, 0.0, 0.5).double()
    return Affine(centre, torch.zeros_like(difference.slopes), radius)


def _where(condition: Affine | Tensor, a: Affine | Number, b: Affine | Number) -> Affine:
    """Where the condition holds in a part of a box only, the forms contain both values."""
    like = next(form for form in (condition, a, b) if isinstance(form, Affine))
    a, b = Affine.of(a, like), Affine.of(b, like)
    if not isinstance(condition, Affine):
        return a.where(condition, b)
    middle, apart = (a + b) * 0.5, (a - b) * 0.5
    reach = torch.maximum(apart.high, -apart.low)
    both = Affine(middle.centre, middle.slopes, (middle.radius + reach) * (1 + 1e-12))
    return a.where(condition.low > 0.5, b.where(condition.high < 0.5, both))


def _maximum(a: Affine | Tensor, b: Affine | Tensor) -> Affine:
    return (a + b + _abs(Affine.of(a, b) - b)) * 0.5  # type: ignore[operator]


def _minimum(a: Affine | Tensor, b: Affine | Tensor) -> Affine:
    return (a + b - _abs(Affine.of(a, b) - b)) * 0.5  # type: ignore[operator]


def _clamp(z: Affine, min: Number | None = None, max: Number | None = None) -> Affine:
    if min is not None:
        z = _maximum(z, torch.as_tensor(min, dtype=torch.float64))
    return z if max is None else _minimum(z, torch.as_tensor(max, dtype=torch.float64))


def _extreme(pairwise: Callable[[Affine, Affine], Affine]) -> Callable[..., Affine]:
    def reduced(z: Affine, dim: int = -1, keepdim: bool = False) -> Affine:
        result, *others = unbind(z, dim)
        for other in others:
            result = pairwise(result, other)
        return unsqueeze(result, dim) if keepdim else result

    return reduced


def _matmul(a: Affine | Tensor, b: Affine | Tensor) -> Affine:
    """The product of forms with a matrix, or of a matrix (k, l) with columns (N, l, j) of forms."""
    if isinstance(a, Affine):
        return a.matmul(b)  # type: ignore[arg-type]
    assert isinstance(b, Affine)
    if a.ndim != 2 or b.ndim < 3:
        raise ProofError(
            f"matmul: expected a matrix (k, l) and columns (N, l, j), got shapes {tuple(a.shape)} and {tuple(b.shape)}"
        )
    return b.map(_transposed).matmul(a.mT).map(_transposed)


def _transposed(entry: Tensor) -> Tensor:
    return entry.mT


def _norm(z: Affine, p: Any = None, dim: Any = -1, keepdim: bool = False, ord: Any = None, **_: Any) -> Affine:
    """The Euclidean norm; where it can be 0 in a box, an interval."""
    if not {p, ord} <= {None, 2, "fro"}:
        raise ProofError(f"norm: expected the Euclidean norm of order 2, got order {ord if p is None else p!r}")
    squares = _square(z).total(dim if isinstance(dim, int) else dim[0], keepdim)
    low, high = squares.low.clamp(min=0).sqrt(), squares.high.clamp(min=0).sqrt()
    interval = Affine((low + high) / 2, torch.zeros_like(squares.slopes), (high - low) / 2 + 1e-15 * high)
    safe = squares.low > LEAST
    shifted = squares.where(safe, torch.ones_like(squares.centre))
    return _sqrt(shifted).where(safe, interval)


def _distances(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest absolute value in intervals."""
    least = torch.where((low < 0) & (high > 0), torch.zeros_like(low), torch.minimum(low.abs(), high.abs()))
    return least, torch.maximum(low.abs(), high.abs())


def _require(name: str, low: Tensor) -> None:
    if not bool((low > LEAST).all()):
        raise ProofError(f"{name}: its argument is not positive in a box")


def _constant(bound: float) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda low, high: torch.full_like(low, bound)


FUNCTIONS.update(
    {
        "add": lambda a, b: Affine.of(a, b) + b,
        "sub": lambda a, b: Affine.of(a, b) - b,
        "rsub": lambda a, b: Affine.of(b, a) - a,
        "mul": lambda a, b: Affine.of(a, b) * b,
        "div": lambda a, b: Affine.of(a, b) / b,
        "truediv": lambda a, b: Affine.of(a, b) / b,
        "subtract": lambda a, b: Affine.of(a, b) - b,
        "multiply": lambda a, b: Affine.of(a, b) * b,
        "divide": lambda a, b: Affine.of(a, b) / b,
        "neg": lambda a: -a,
        "positive": lambda a: a,
        "pow": lambda a, b: a**b,
        "square": _square,
        "reciprocal": _reciprocal,
        "abs": _abs,
        "sqrt": _sqrt,
        "exp": _exp,
        "log": _log,
        "sin": _sin,
        "cos": _cos,
        "tan": _tan,
        "atan": _atan,
        "tanh": _tanh,
        "sigmoid": _sigmoid,
        "silu": lambda z, inplace=False: _silu(z),
        "softplus": _softplus,
        "relu": lambda z, inplace=False: _clamp(z, min=0.0),
        "maximum": _maximum,
        "minimum": _minimum,
        "clamp": _clamp,
        "clip": _clamp,
        "gt": _greater,
        "ge": _greater,
        "lt": lambda a, b: _greater(b, a),
        "le": lambda a, b: _greater(b, a),
        "and": _minimum,
        "logical_and": _minimum,
        "or": _maximum,
        "logical_or": _maximum,
        "invert": lambda a: 1 - a,
        "logical_not": lambda a: 1 - a,
        "sign": lambda z: _greater(z, 0.0) * 2 - 1,
        "where": _where,
        "amax": _extreme(_maximum),
        "amin": _extreme(_minimum),
        "norm": _norm,
        "linalg_norm": _norm,
        "linalg_vector_norm": _norm,
        "sum": lambda z, dim=-1, keepdim=False: z.total(dim, keepdim),
        "matmul": _matmul,
    }
)
