"""Points of the faces of A and B, at which W is given, and points of the sides of its box."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from pirl_rl.descent import descended
from pirl_rl.errors import ProofError
from pirl_rl.proofs.ends import NEAR, Ends
from pirl_rl.proofs.mesh import Mesh, product

INNER_SHARPNESS = 2.0
"""The sharpness of the corners of the set in A on whose face W is 1, in relation to the depth of A."""

INSET = 0.1
"""How deep in A that set lies, in relation to the depth of A: W may be curved sharply between both faces."""

OUTER_SHARPNESS = 6.0
"""The sharpness of the corners of the set around A on whose face W is 0, in relation to the depth of A."""

OFF = 1.5
"""How far in B the set without corners lies on whose face W is 1, in cells of the mesh, about."""

SEARCHED = 256
"""The number of states from which the levels of A are descended where no state of the mesh lies in A."""

NEWTON_STEPS = 20
"""The number of steps in which a point is moved to a face."""

REACH = 1.5
"""Points within this number of cells of a face are moved to it."""

Level = Callable[[Tensor], Tensor]
"""Maps states (P, n) to a level (P,), which is negative in a set and 0 on its face."""


def smooth_target(ends: Ends, x: Tensor) -> Level:
    """The level of a set without corners in place of A, at whose corners W would have to be curved without bound.

    W is given on its face: 1 on that of a set in A, since W <= 1 is all that A asks, and 0 on that of a set around A.
    With one constraint both are A itself. With more it is the logarithm of the sum of exponentials of all constraints,
    each in relation to the depth of A. This is above their maximum, by at most the logarithm of their number.

    Args:
        ends: gives the constraints of A.
        x: states (P, n), out of which those in A give its depth.

    Raises:
        ProofError: A has several constraints, and no state is found that lies in it.
    """
    count = ends.target(x[:1]).shape[-1]
    if count == 1:
        return lambda states: ends.target(states)[..., 0]
    depth = _depth(ends, x)
    if ends.at_target == 1:
        return lambda states: torch.logsumexp(INNER_SHARPNESS * (ends.target(states) / depth + INSET), -1)
    return lambda states: torch.logsumexp(OUTER_SHARPNESS * ends.target(states) / depth, -1) - math.log(count)


def smooth_avoid(ends: Ends, mesh: Mesh, x: Tensor) -> Level:
    """The level of a set in place of B, without the corners at which a W that is 1 on both sides could not rise in tau.

    With one level, or one state, or where W is 0 on its face, the set is B itself. Otherwise it is a set in B, a little
    off its face, since W <= 1 is all that B asks.

    Args:
        ends: gives the levels of B.
        mesh: gives the size of the cells.
        x: states (P, n) of the mesh.
    """
    if not ends.has_rounded_avoid:
        return ends.problem.avoid_level
    depth, sharpness = ends.avoid(x).amax(0), math.log(2) * min(mesh.cells[1:]) / (2 * OFF)

    def level(states: Tensor) -> Tensor:
        return (math.log(2) - torch.logsumexp(-sharpness * ends.avoid(states) / depth, -1)) / sharpness

    return level


def _depth(ends: Ends, x: Tensor) -> Tensor:
    """How far below 0 each constraint (k,) of A comes in A."""
    levels = ends.target(x)
    inside = levels[(levels < 0).all(-1)]
    if not len(inside):
        # A is thinner than the mesh.
        levels = ends.target(descended(ends.target, x[:: -(-len(x) // SEARCHED)], ends.problem.states))
        inside = levels[(levels < 0).all(-1)]
    if not len(inside):
        name = type(ends.problem).__name__
        raise ProofError(f"proof: no state is found inside the target of {name}, between its faces; make it thicker")
    return -inside.amin(0)


def face_points(level: Level, mesh: Mesh, x: np.ndarray) -> np.ndarray:
    """Points (P, n) in the box at which a level is 0, one for each state (N, n) of the mesh that is near its face.

    They are found by Newton's steps along the gradient, each coordinate in relation to the width of the box.
    """
    low, high = mesh.low, mesh.high
    cell = torch.from_numpy((high - low) / np.array(mesh.cells[1:]))
    states = torch.from_numpy(x)
    value, slope = _level_and_slope(level, states)
    size = value.abs().max()
    near = value.abs() < REACH * (slope * cell).norm(dim=-1)
    points = states[near]
    for _ in range(NEWTON_STEPS):
        value, slope = _level_and_slope(level, points)
        length = (slope * cell).square().sum(-1).clamp(min=torch.finfo(torch.float64).tiny)
        points = points - slope * cell.square() * (value / length).unsqueeze(-1)
    found = (level(points).abs() < NEAR * size).numpy()
    result = points.numpy()
    within = ((result >= low - NEAR * (high - low)) & (result <= high + NEAR * (high - low))).all(-1)
    return np.clip(result[found & within], low, high)


def _level_and_slope(level: Level, x: Tensor) -> tuple[Tensor, Tensor]:
    x = x.detach().requires_grad_()
    value = level(x)
    return value.detach(), torch.autograd.grad(value.sum(), x)[0]


def sides(ends: Ends, mesh: Mesh, places: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, n) on the sides of the box outside A, and the directions (P, n) that lead out of it.

    Args:
        ends: gives A.
        mesh: the mesh of the box.
        places: where the points lie in each cell along the other axes, in [0, 1].
    """
    axes = mesh.points(places)
    parts, outward = [], []
    for axis, edges in enumerate(mesh.space):
        for end, sign in ((edges[0], -1), (edges[-1], 1)):
            parts.append(product([*axes[:axis], np.array([end]), *axes[axis + 1 :]]))
            outward.append(np.tile(sign * np.eye(len(axes))[axis], (len(parts[-1]), 1)))
    x = np.concatenate(parts)
    outside = ~ends.in_target(torch.from_numpy(x)).numpy()
    return x[outside], np.concatenate(outward)[outside]


def downward(level: Level, x: np.ndarray) -> np.ndarray:
    """The directions (P, n) at states (P, n) in which a level falls."""
    return -_level_and_slope(level, torch.from_numpy(x))[1].numpy()


def cells_from(levels: Level, mesh: Mesh, x: np.ndarray) -> np.ndarray:
    """The distances (P, k) of states (P, n) from the zeros of levels (P, k), to first order, in cells of the mesh."""
    distances, states, widths = [], torch.from_numpy(x), mesh.widths_at(x)
    for i in range(levels(states[:1]).shape[-1]):
        value, slope = _level_and_slope(lambda y, i=i: levels(y)[..., i], states)
        steepness = np.linalg.norm(slope.numpy() * widths, axis=-1)
        distances.append(value.numpy() / np.maximum(steepness, np.finfo(float).tiny))
    return np.stack(distances, -1)
