"""Checks of the methods as functions: types, shapes, batches, side effects, random numbers, and finite results."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from pirl_rl.checking.findings import Finding, found, hint, raised_in
from pirl_rl.checking.samples import LEVELS, Function, Samples
from pirl_rl.errors import ProblemError
from pirl_rl.structure import check_problem

FEW = 16
"""The number of states at which types and batches are checked."""

CLOSE = 1e-9
"""The difference of results in double precision that counts as rounding, relative to the largest at any state."""


def calls(samples: Samples) -> Iterator[Finding]:
    """Each method must take states in single and double precision, and return tensors of the same dtype."""
    problem = samples.problem
    for name, method in samples.methods.items():
        for dtype in (torch.float64, torch.float32):
            x, u = samples.x[:FEW].to(dtype), samples.u[:FEW].to(dtype)
            try:
                value = method(x, u)
            except Exception as error:
                message = f"expected a result for states of shape ({FEW}, {x.shape[-1]}), got {_summary(error)}."
                yield found(problem, "error", name, message, place=raised_in(error))
                break
            expected = torch.bool if name == "unreachable" else dtype
            got = value.dtype if isinstance(value, Tensor) else type(value).__name__
            if got != expected:
                message = f"expected a tensor of {expected} for states of {dtype}, got {got}."
                yield found(problem, "error", name, message)
                break


def shapes(samples: Samples) -> Iterator[Finding]:
    """The parts must fit together, see `check_problem`."""
    problem, name = samples.problem, type(samples.problem).__name__
    try:
        check_problem(problem)
    except ProblemError as error:
        part, _, message = str(error).removeprefix(f"{name}.").partition(": ")
        if part not in samples.methods:
            part, message = "states", str(error).removeprefix(f"{name}: ")
        yield found(problem, "error", part, f"{message}.")


def arrangements(samples: Samples) -> Iterator[Finding]:
    """The results must be the same however the states are arranged."""
    problem = samples.problem
    x, u = samples.x[:FEW], samples.u[:FEW]
    for part, method in samples.methods.items():
        expected = method(x, u)
        for shape in ((2, FEW // 2), (1, FEW)):
            try:
                got = method(x.reshape(*shape, -1), u.reshape(*shape, -1))
                same = _same(got, expected.reshape(*shape, *expected.shape[1:]))
                outcome = f"a result of shape {tuple(got.shape)}" if not same else ""
            except Exception as error:
                same, outcome = False, _summary(error)
            if not same:
                example = (*shape, x.shape[-1])
                yield found(
                    problem,
                    "error",
                    part,
                    f"expected the results of {FEW} states also where they are arranged as {example}, got {outcome}; "
                    "take coordinates by x[..., i] and reduce over dim=-1.",
                )
                break


def batches(samples: Samples) -> Iterator[Finding]:
    """The result of a state must not depend on the other states of its batch."""
    x, u = samples.x[:FEW], samples.u[:FEW]
    for part, method in samples.methods.items():
        whole = method(x, u)
        for rows in (slice(0, 1), slice(3, 10)):
            alone = method(x[rows], u[rows])
            differs = ~_rows_equal(alone, whole[rows])
            if differs.any():
                message = "expected a result for each state by itself, but it changes with the other states of a batch."
                yield found(samples.problem, "error", part, message, x[rows][differs][0])
                break


def side_effects(samples: Samples) -> Iterator[Finding]:
    """A method must neither change its arguments nor draw random numbers."""
    for part, method in samples.methods.items():
        x, u = samples.x.clone(), samples.u.clone()
        first = method(x, u)
        for name, now, before in (("x", x, samples.x), ("u", u, samples.u)):
            if not torch.equal(now, before):
                message = f"expected {name} to stay as it is, but the method changes it in place; work on a copy."
                yield found(samples.problem, "error", part, message)
        if not _same(method(samples.x.clone(), samples.u.clone()), first):
            message = "expected the same result whenever it is called, but it draws random numbers or keeps a state; "
            yield found(samples.problem, "error", part, message + "noise belongs into the columns of diffusion.")


def finite(samples: Samples) -> Iterator[Finding]:
    """Results must be finite in the box outside A and B, and should be beyond it, where paths go too."""
    for part, method in samples.methods.items():
        for level, x in (("error", samples.x), ("warning", samples.beyond)):
            value = method(x, samples.u).reshape(len(x), -1)
            # A level may be infinite where its set is out of reach, as that of an empty set is.
            bad = (value.isnan() if part in LEVELS else ~value.isfinite()).any(-1)
            # Inside a set the physics is not asked.
            bad = bad & (samples.problem.interior(x) | ~samples.problem.states.contains(x))
            if bad.any():
                where = "in the box of states" if level == "error" else "beyond the box, where paths may go"
                message = f"expected finite numbers, got NaN or infinite ones at {_share(bad)} of the states {where}."
                yield found(samples.problem, level, part, message, x[bad][0])  # type: ignore[arg-type]
                break


def derivatives(samples: Samples) -> Iterator[Finding]:
    """The drift must be differentiable in the control, and levels in the state."""
    problem, x, u = samples.problem, samples.x, samples.u
    for part, method in samples.methods.items():
        if part in LEVELS:
            varied, slope = _spread(method, x, u), _slope(lambda y, method=method: method(y, u), x)
            need = "the bridge, the descent towards thin sets and the networks use the slope of levels"
        elif part == "drift":
            other = method(x, u.roll(1, 0))
            varied = float((other - method(x, u)).abs().max())
            slope = _slope(lambda v: problem.drift(x, v), u)
            need = "the actor rules Hamiltonian and LookAhead use the slope of the drift in u"
        else:
            continue
        if isinstance(slope, str):
            message = f"expected a function that torch can differentiate, got {slope}{hint(slope)}; {need}."
            yield found(problem, "error", part, message)
        elif part in LEVELS and (bad := ~slope.isfinite().all(-1) & problem.interior(x)).any():
            message = (
                f"expected finite derivatives, got NaN or infinite ones at {_share(bad)} of the states. A branch of "
                f"torch.where that is not taken is differentiated too, so give it valid arguments; {need}."
            )
            yield found(problem, "error", part, message, x[bad][0])
        elif varied > 0 and not (slope != 0).any():
            message = f"expected a slope, but its derivative is 0 at all {len(x)} states while its values vary; {need}."
            yield found(problem, "warning", part, message)


def _slope(function, x: Tensor) -> Tensor | str:
    """The derivative of a random combination of a function's results at x, or what torch says instead."""

    def combined(y: Tensor) -> Tensor:
        value = function(y).nan_to_num(posinf=0.0, neginf=0.0)
        return (value * torch.rand(value.shape, generator=torch.Generator().manual_seed(0), dtype=y.dtype)).sum()

    try:
        return torch.func.grad(combined)(x)
    except Exception as error:
        return _summary(error)


def _spread(method: Function, x: Tensor, u: Tensor) -> float:
    value = method(x, u)
    value = value[value.isfinite()]
    return float(value.max() - value.min()) if len(value) else 0.0


def _same(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and bool(_rows_equal(one, other).all())


def _rows_equal(one: Tensor, other: Tensor) -> Tensor:
    """Whether the rows of two results (N, ...) are the same except for rounding, (N,) bool."""
    one, other = one.double(), other.double()
    size = one.nan_to_num(0.0, 0.0, 0.0).abs().amax(0)
    same = (one == other) | (one.isnan() & other.isnan()) | ((one - other).abs() <= CLOSE * size)
    return same.reshape(len(one), -1).all(-1)


def _share(bad: Tensor) -> str:
    return f"{int(bad.sum())} of {len(bad)}"


def _summary(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
