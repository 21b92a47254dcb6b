"""Candidate controls, among which policy iteration chooses the best one at each node.

Up to `MOST` of them are the tensor product of equidistant levels along the axes of the box of controls. For a drift
that is affine in u and a sigma without u the best control is a vertex of the box, and two levels would do; more levels
are for other problems and for nodes at which no vertex is good.

With more controls the tensor product is too large. Then there is one candidate for each direction p in which grad V
may point: the control with the largest p . f(x, u), found axis by axis, which is exact for an affine drift. Their
number depends on n and their cost is linear in m.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem

MOST = 32
"""The largest number of candidates in a tensor product: three controls have 27 with three levels."""

SWEEPS = 2
"""Number of times that every axis of the control is improved with the others held."""


def candidates(problem: ReachAvoidProblem, x: np.ndarray, spacing: np.ndarray, levels: int) -> np.ndarray:
    """Controls (K, M, m), in SI units, at nodes x (M, n) of a mesh with spacing (n,), with `levels` along each axis."""
    controls, m = problem.controls, problem.controls.dim
    marks = np.linspace(-1.0, 1.0, levels)
    if levels**m <= MOST:
        chosen = controls.denormalize(torch.tensor(list(product(marks, repeat=m)), dtype=torch.float64)).numpy()
        return np.broadcast_to(chosen[:, None], (len(chosen), len(x), m))
    points = torch.from_numpy(x)
    steepest = [
        _steepest(problem, points, torch.tensor(direction / spacing), marks)
        for direction in product((-1, 0, 1), repeat=x.shape[1])
    ]
    return controls.denormalize(torch.stack(steepest)).numpy()


def _steepest(problem: ReachAvoidProblem, x: Tensor, direction: Tensor, marks: np.ndarray) -> Tensor:
    """The normalised control (M, m) with the largest direction . f(x, u), axis by axis from the middle of the box."""
    action = x.new_zeros(len(x), problem.controls.dim)
    best = problem.drift(x, problem.controls.denormalize(action)) @ direction
    for axis in list(range(action.shape[1])) * SWEEPS:
        for mark in marks:
            trial = action.clone()
            trial[:, axis] = mark
            speed = problem.drift(x, problem.controls.denormalize(trial)) @ direction
            action = torch.where((speed > best).unsqueeze(-1), trial, action)
            best = torch.maximum(speed, best)
    return action
