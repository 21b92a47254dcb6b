"""The smooth continuation of W into the target, where no condition holds.

V has a kink at the face of A. A spline that is 1 in all of A would be curved downwards in the cells outside the face,
where L^pi W >= 0 must hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.mesh import Mesh

NEWTON_STEPS = 20
"""The number of steps in which a node is moved to the face."""


def continuation_rows(problem: ReachAvoidProblem, mesh: Mesh, inside: np.ndarray) -> tuple[Any, np.ndarray]:
    """Rows of the linear system for the nodes in A.

    A node next to the outside stands for the nearest point of the face, where W is given. At the others the fourth
    differences of the coefficients vanish.

    Args:
        problem: gives the level of A.
        mesh: the mesh.
        inside: whether each node lies in A (N,).

    Returns:
        The rows (N, N), which are empty for nodes outside A, and whether a node is next to the outside (N,).
    """
    shape = mesh.shape
    near = (_next_to(~inside.reshape(shape)) & inside.reshape(shape)).ravel()
    rows = sp.lil_matrix((len(inside), len(inside)))
    if near.any():
        rows[near] = mesh.at(_on_face(problem, mesh, mesh.nodes()[near]))
    for node in np.flatnonzero(inside & ~near).tolist():
        _add_differences(rows, node, shape)
    return rows.tocsr(), near


def _next_to(outside: np.ndarray) -> np.ndarray:
    """Whether one of the two neighbours along an axis is outside."""
    result = np.zeros_like(outside)
    for axis in range(outside.ndim):
        padded = np.pad(outside, [(int(i == axis),) * 2 for i in range(outside.ndim)])
        for shift in (0, 2):
            result |= np.take(padded, np.arange(outside.shape[axis]) + shift, axis)
    return result


def _on_face(problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray) -> np.ndarray:
    """The points (P, n) of the face of A next to states (P, n), by Newton steps along the gradient of its level."""
    points, width = torch.from_numpy(x), torch.tensor([axis[-1] - axis[0] for axis in mesh.edges[1:]])
    for _ in range(NEWTON_STEPS):
        points = points.detach().requires_grad_()
        level = problem.reached_constraints(points).amax(-1)
        slope = torch.autograd.grad(level.sum(), points)[0]
        length = (slope * width).square().sum(-1).clamp(min=1e-30)
        points = points - slope * width.square() * (level / length).unsqueeze(-1)
    return points.detach().numpy()


def _add_differences(rows: sp.lil_matrix, node: int, shape: Sequence[int]) -> None:
    """Add the fourth differences along all axes to the row of a node."""
    place = np.unravel_index(node, shape)
    for axis, size in enumerate(shape):
        # Near an edge of the mesh the node itself is the outermost of the five, so that no two rows are equal.
        first = place[axis] - (4 if place[axis] + 4 >= size else 0 if place[axis] < 4 else 2)
        for offset, weight in enumerate((1.0, -4.0, 6.0, -4.0, 1.0)):
            other = list(place)
            other[axis] = first + offset
            rows[node, np.ravel_multi_index(other, shape)] += weight
