"""Points of the faces of A and B, at which W is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from pirl_rl.errors import ProofError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.mesh import NEAR, Mesh, product

SHARPNESS = 2.0
"""The sharpness of the corners of the set in A on whose face W is 1, in relation to the depth of A."""

INSET = 0.1
"""How deep in A its smooth part lies, in relation to the depth of A: W may be curved sharply between both faces."""

NEWTON_STEPS = 20
"""The number of steps in which a point is moved to a face."""

REACH = 1.5
"""Points within this number of cells of a face are moved to it."""

Level = Callable[[Tensor], Tensor]
"""Maps states (P, n) to a level (P,), which is negative in a set and 0 on its face."""


def smooth_target(problem: ReachAvoidProblem, x: Tensor) -> Level:
    """The level of a set in A without corners, at which W would have to be curved without bound.

    With more than one constraint it is the logarithm of the sum of exponentials of all constraints, each in relation to
    the depth of A. It is above their maximum.

    Args:
        problem: gives the constraints of A.
        x: states (P, n), of which some lie in A.

    Raises:
        ProofError: A has several constraints, and no state lies in it.
    """
    levels = problem.reached_constraints(x)
    if levels.shape[-1] == 1:
        return lambda states: problem.reached_constraints(states)[..., 0]
    inside = levels[(levels < 0).all(-1)]
    if not len(inside):
        raise ProofError("proof: no point of the mesh lies in the target; give more cells")
    depth = -inside.amin(0)
    return lambda states: torch.logsumexp(SHARPNESS * (problem.reached_constraints(states) / depth + INSET), -1)


def face_points(level: Level, mesh: Mesh, x: np.ndarray) -> np.ndarray:
    """Points (P, n) in the box at which a level is 0, one for each state (N, n) of the mesh that is near its face.

    They are found by Newton's steps along the gradient, each coordinate in relation to the width of the box.
    """
    low, high = mesh.low, mesh.high
    cell = torch.from_numpy((high - low) / np.array(mesh.cells[1:]))
    states = torch.from_numpy(x)
    value, slope = _level_and_slope(level, states)
    near = value.abs() < REACH * (slope * cell).norm(dim=-1)
    points = states[near]
    for _ in range(NEWTON_STEPS):
        value, slope = _level_and_slope(level, points)
        length = (slope * cell).square().sum(-1).clamp(min=torch.finfo(torch.float64).tiny)
        points = points - slope * cell.square() * (value / length).unsqueeze(-1)
    found = (level(points).abs() < NEAR).numpy()
    result = points.numpy()
    within = ((result >= low - NEAR * (high - low)) & (result <= high + NEAR * (high - low))).all(-1)
    return np.clip(result[found & within], low, high)


def _level_and_slope(level: Level, x: Tensor) -> tuple[Tensor, Tensor]:
    x = x.detach().requires_grad_()
    value = level(x)
    return value.detach(), torch.autograd.grad(value.sum(), x)[0]


def sides(problem: ReachAvoidProblem, mesh: Mesh, places: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (P, n) on the sides of the box outside A, the axes (P,) of the sides, and -1 or 1 (P,) for lower or upper.

    Args:
        problem: gives A.
        mesh: the mesh of the box.
        places: where the points lie in each cell along the other axes, in [0, 1].
    """
    axes = mesh.points(places)
    x, number, outward = [], [], []
    for axis, edges in enumerate(mesh.space):
        for end, sign in ((edges[0], -1), (edges[-1], 1)):
            x.append(product([*axes[:axis], np.array([end]), *axes[axis + 1 :]]))
            number.append(np.full(len(x[-1]), axis))
            outward.append(np.full(len(x[-1]), sign))
    result = np.concatenate(x), np.concatenate(number), np.concatenate(outward)
    if problem.objective == "invariance":
        return result
    outside = ~(problem.reached_constraints(torch.from_numpy(result[0])) <= NEAR).all(-1).numpy()
    return result[0][outside], result[1][outside], result[2][outside]
