"""Candidate controls, among which policy iteration chooses the best one at each node.

They are the tensor product of equidistant levels along the axes of the box of controls. For a drift that is affine in u
and a sigma without u the best control is a vertex of the box, and three levels are enough. Otherwise it may lie
anywhere in the box, and there are as many levels as `MOST` candidates allow; a coordinate in which the drift is affine
while the others stand still, as the speed beside the heading, still has three.

With more controls the tensor product is too large. Then there is one candidate for each direction p in which grad V
may point: the control with the largest p . f(x, u), found axis by axis, which is exact for an affine drift and a sigma
without u. Where sigma depends on u there are two more for each direction, which have the largest and the smallest
p . f(x, u) +- |sigma(x, u)|^2 / 2 in units of the mesh, since much noise may be good or bad. Their number depends on n
and their cost is linear in m.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np
import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.structure import has_controlled_noise, is_affine_in, is_control_affine

FEW = 32
"""The largest number of candidates in a tensor product where vertices are enough: three controls have 27."""

MOST = {1: 128, 2: 128, 3: 32}
"""The largest number of candidates in a tensor product where they are not, by the number of states."""

VERTEX_LEVELS, LEVELS = 3, 33
"""The number of levels of a control whose best value is a bound, and the largest number that is chosen otherwise."""

SWEEPS = 2
"""Number of times that every axis of the control is improved with the others held."""


def candidates(problem: ReachAvoidProblem, x: np.ndarray, spacing: np.ndarray, levels: int | None = None) -> np.ndarray:
    """Controls (K, M, m), in SI units, at nodes x (M, n) of a mesh with spacing (n,).

    Args:
        problem: the physics.
        x: the nodes.
        spacing: the distances of nodes along each axis.
        levels: the number of levels of each control; by default it follows from the problem.
    """
    controls, m = problem.controls, problem.controls.dim
    most = FEW if is_control_affine(problem) else MOST[problem.states.dim]
    numbers = _numbers_of_levels(problem, most) if levels is None else [levels] * m
    axes = [np.linspace(-1.0, 1.0, number) for number in numbers]
    if math.prod(numbers) <= most:
        chosen = controls.denormalize(torch.tensor(list(product(*axes)), dtype=torch.float64)).numpy()
        return np.broadcast_to(chosen[:, None], (len(chosen), len(x), m))
    points, distances = torch.from_numpy(x), torch.from_numpy(spacing)
    signs = (-1, 0, 1) if has_controlled_noise(problem) else (0,)
    steepest = [
        _steepest(problem, points, distances, torch.tensor(direction, dtype=torch.float64), sign, axes)
        for direction in product((-1, 0, 1), repeat=x.shape[1])
        for sign in signs
    ]
    return controls.denormalize(torch.stack(steepest)).numpy()


def _numbers_of_levels(problem: ReachAvoidProblem, most: int) -> list[int]:
    """The number of levels of each coordinate of the control, whose product is at most `most` where that can be."""
    at_bounds = [is_affine_in(problem, axis) for axis in range(problem.controls.dim)]
    others = at_bounds.count(False)
    few = VERTEX_LEVELS ** at_bounds.count(True)
    # An odd number has the middle of the box among the levels.
    many = next((k for k in range(LEVELS, 3, -2) if few * k**others <= most), VERTEX_LEVELS)
    return [VERTEX_LEVELS if bound else many for bound in at_bounds]


def _steepest(
    problem: ReachAvoidProblem, x: Tensor, spacing: Tensor, direction: Tensor, sign: int, axes: Sequence[np.ndarray]
) -> Tensor:
    """The normalised control (M, m) with the largest direction . f(x, u) + sign |sigma(x, u)|^2 / 2, in units of the
    mesh, axis by axis from the middle of the box."""

    def score(action: Tensor) -> Tensor:
        u = problem.controls.denormalize(action)
        speed = problem.drift(x, u) @ (direction / spacing)
        if sign:
            variance = (problem.diffusion(x, u) / spacing[:, None]).square().sum((-2, -1))
            speed = speed + sign * variance / 2
        return speed.nan_to_num(nan=-math.inf)

    action = x.new_zeros(len(x), problem.controls.dim)
    best = score(action)
    for axis in list(range(action.shape[1])) * SWEEPS:
        for mark in axes[axis]:
            trial = action.clone()
            trial[:, axis] = mark
            found = score(trial)
            action = torch.where((found > best).unsqueeze(-1), trial, action)
            best = torch.maximum(found, best)
    return action
