"""The structure of a problem: the sets at which paths end, the number of noise channels, how drift and noise depend on
the control, and whether all parts fit together. Functions are judged at random states and controls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.errors import ProblemError
from pirl_rl.problem import WIDER, ReachAvoidProblem

ROUNDING = 1e-9
"""The relative difference from an affine drift, in double precision, that counts as rounding."""

PERIOD_POINTS = 1_000
"""The number of states at which both ends of a period are compared."""

PERIOD_TOLERANCE = 1e-4
"""The relative difference at both ends of a period that counts as rounding, also of a function in single precision."""


class AbsorbingSet(NamedTuple):
    """A set at which paths end, as a union of parts: a part is where all of its levels are at most 0.

    Attributes:
        name: of the set, for messages.
        contains: whether states (N, n) are in the set, (N,) bool.
        value: V in the set.
        levels: the k levels (N, k) of all parts at states (N, n).
        parts: which of them each part has (parts, k), bool.
    """

    name: str
    contains: Callable[[Tensor], Tensor]
    value: float
    levels: Callable[[Tensor], Tensor]
    parts: Tensor


def absorbing_sets(problem: ReachAvoidProblem) -> list[AbsorbingSet]:
    """A, whose constraints make one part, and B, of which each constraint is a part; a set that is absent is left out.

    In an invariance problem A does not end paths, and is left out too.
    """
    sets, center = [], problem.states.denormalize(torch.zeros(1, problem.states.dim))
    if problem.objective == "reach-avoid":
        levels = problem.scaled_reached_constraints
        whole = torch.ones_like(levels(center), dtype=torch.bool)
        sets.append(AbsorbingSet("target", problem.reached, 1.0, levels, whole))
    if problem.has_avoid_set:
        levels = problem.scaled_avoid_constraints
        each = torch.eye(levels(center).shape[-1], dtype=torch.bool)
        sets.append(AbsorbingSet("avoid set", problem.failed, 0.0, levels, each))
    return sets


def noise_channels(problem: ReachAvoidProblem) -> int:
    """The number w of columns of sigma."""
    x, u = (box.denormalize(torch.zeros(1, box.dim)) for box in (problem.states, problem.controls))
    return problem.diffusion(x, u).shape[-1]


def has_controlled_noise(problem: ReachAvoidProblem) -> bool:
    """Whether sigma depends on u, see `controlled_channels`."""
    return any(controlled_channels(problem))


def controlled_channels(problem: ReachAvoidProblem, points: int = 256, seed: int = 0) -> list[list[int]]:
    """For each coordinate of u the numbers of the columns of sigma that depend on it.

    Args:
        problem: the physics.
        points: the number of random states, each with two controls that differ in the coordinate alone.
        seed: of the points.
    """
    x, one, drawn, _ = _random_points(problem, points, seed)
    sigma, found = problem.diffusion(x, one), []
    for axis in range(problem.controls.dim):
        other = problem.diffusion(x, _with_coordinate(one, axis, drawn))
        # Inside a set sigma may have no number, which differs from itself.
        changed = ((other != sigma) & ~(other.isnan() & sigma.isnan())).any(0).any(0)
        found.append(changed.nonzero().squeeze(-1).tolist())
    return found


def is_control_affine(problem: ReachAvoidProblem, points: int = 256, seed: int = 0) -> bool:
    """Whether the drift is affine in u and sigma does not depend on u, judged at random states and controls.

    Args:
        problem: the physics.
        points: the number of states, each with two controls and a random point on the line through them.
        seed: of the points.
    """
    x, one, other, rng = _random_points(problem, points, seed)
    return _is_affine_between(problem, x, one, other, rng) and not has_controlled_noise(problem)


def is_affine_in(problem: ReachAvoidProblem, axis: int, points: int = 256, seed: int = 0) -> bool:
    """Whether the drift is affine in one coordinate of u while the others stand still, and sigma does not depend on it.

    The Hamiltonian has its maximum over this coordinate at one of its bounds then, whatever the others are.

    Args:
        problem: the physics.
        axis: the coordinate, counted from 0.
        points: the number of states, each with two controls and a random point on the line through them.
        seed: of the points.
    """
    x, one, drawn, rng = _random_points(problem, points, seed)
    affine = _is_affine_between(problem, x, one, _with_coordinate(one, axis, drawn), rng)
    return affine and not controlled_channels(problem)[axis]


def _random_points(
    problem: ReachAvoidProblem, points: int, seed: int
) -> tuple[Tensor, Tensor, Tensor, torch.Generator]:
    """States (N, n) with two controls (N, m) each, in double precision, and the generator that has drawn them."""
    rng = torch.Generator().manual_seed(seed)
    boxes = problem.states, problem.controls, problem.controls
    x, one, other = (box.sample(points, rng, torch.float64) for box in boxes)
    return x, one, other, rng


def _with_coordinate(u: Tensor, axis: int, drawn: Tensor) -> Tensor:
    """Controls (N, m) with one coordinate from other controls (N, m)."""
    changed = u.clone()
    changed[:, axis] = drawn[:, axis]
    return changed


def _is_affine_between(problem: ReachAvoidProblem, x: Tensor, one: Tensor, other: Tensor, rng: torch.Generator) -> bool:
    """Whether the drift at states x (N, n) is affine on the lines through two controls, (N, m) each."""
    share = torch.rand(len(x), 1, generator=rng, dtype=x.dtype)
    expected = (1 - share) * problem.drift(x, one) + share * problem.drift(x, other)
    gap = (problem.drift(x, (1 - share) * one + share * other) - expected).abs()
    # Inside a set the drift may have no number.
    return bool((gap.nan_to_num(0.0) <= ROUNDING * expected.nan_to_num(0.0).abs().amax(0)).all())


def check_problem(problem: ReachAvoidProblem) -> None:
    """Refuse a problem whose parts are missing, have wrong shapes, or contradict each other.

    Args:
        problem: the problem to check.

    Raises:
        ProblemError: an attribute is missing, the horizon is not positive or not finite, a control is periodic, names
            of coordinates are not as many as the coordinates, or an output has the wrong shape or differs at both
            ends of a period.
    """
    name = type(problem).__name__
    for attribute in ("horizon", "states", "controls"):
        if not hasattr(problem, attribute):
            raise ProblemError(f"{name} has no {attribute}")
    if not 0 < problem.horizon < float("inf"):
        raise ProblemError(f"{name}: horizon must be positive and finite, got {problem.horizon}")
    if problem.controls.periodic:
        raise ProblemError(f"{name}.controls: only states may be periodic, got {problem.controls}")
    for attribute, box in (("state_names", problem.states), ("control_names", problem.controls)):
        names = getattr(problem, attribute)
        if names and (isinstance(names, str) or [type(entry) for entry in names] != [str] * box.dim):
            raise ProblemError(f"{name}.{attribute}: expected {box.dim} names, got {names!r}")
    rng = torch.Generator().manual_seed(0)
    x = problem.states.expand(WIDER).sample(PERIOD_POINTS, rng, dtype=torch.float64)
    u = problem.controls.sample(16, rng, dtype=torch.float64)
    few, n = x[:16], problem.states.dim
    _expect_shape(f"{name}.drift", problem.drift(few, u), (16, n))
    sigma = problem.diffusion(few, u)
    if sigma.ndim != 3 or sigma.shape[:2] != (16, n):
        raise ProblemError(
            f"{name}.diffusion: expected shape (16, {n}, w) for 16 states, with a column for each of w noise channels, "
            f"got {tuple(sigma.shape)}"
        )
    if sigma.shape[-1] == 0:
        raise ProblemError(
            f"{name}.diffusion: expected at least one column, got none; without noise it is one of zeros"
        )
    for part in ("target_constraints", "avoid_constraints"):
        if getattr(type(problem), part) is not getattr(ReachAvoidProblem, part):
            levels = getattr(problem, part)(few)
            if levels.ndim != 2 or len(levels) != 16 or not levels.shape[-1]:
                message = "expected shape (16, k) for 16 states, one column for each of k >= 1 constraints, got"
                raise ProblemError(f"{name}.{part}: {message} {tuple(levels.shape)}")
    _expect_shape(f"{name}.avoid_level", problem.avoid_level(few), (16,))
    if problem.objective == "reach-avoid":
        _expect_shape(f"{name}.target_level", problem.target_level(few), (16,))
    for axis in problem.states.periodic:
        _expect_period(problem, axis, x, problem.controls.sample(PERIOD_POINTS, rng, torch.float64))


def _expect_period(problem: ReachAvoidProblem, axis: int, x: Tensor, u: Tensor) -> None:
    """Refuse functions that differ at both ends of a periodic axis, at the other coordinates of x (N, n)."""
    low, high = x.clone(), x.clone()
    low[:, axis], high[:, axis] = problem.states.low[axis], problem.states.high[axis]
    functions = {
        "drift": problem.drift,
        "diffusion": problem.diffusion,
        # The levels may differ there, as long as the sets do not.
        "membership of the target": lambda x, u: problem.reached(x).double(),
        "membership of the avoid set": lambda x, u: problem.failed(x).double(),
    }
    for what, function in functions.items():
        one, other = function(low, u), function(high, u)
        scale = float(one[one.isfinite()].abs().amax()) if one.isfinite().any() else 0.0
        # The points are also beyond the other edges of the box, where the physics may have no numbers.
        if not torch.allclose(one, other, rtol=PERIOD_TOLERANCE, atol=PERIOD_TOLERANCE * scale, equal_nan=True):
            raise ProblemError(
                f"{type(problem).__name__}: axis {axis} of states is periodic, so its {what} must be the same at both "
                f"ends of the period, {problem.states.low[axis]:g} and {problem.states.high[axis]:g}, got a difference "
                f"of up to {float((one - other).abs().max()):g}"
            )


def _expect_shape(what: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise ProblemError(f"{what}: expected shape {shape} for 16 states, got {tuple(value.shape)}")
