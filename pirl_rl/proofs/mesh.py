"""The mesh of a proof: cells in space and time, and the nodes at which splines meet conditions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.spline import DEGREE, basis, nodes_of

BEYOND = 0.05
"""The share of the width of the box by which a side that lies in the target is moved outward."""

GRADING = 1.5
"""Levels of tau are (k / steps)^GRADING T, closer where W rises from its values at tau = 0."""


@dataclass(frozen=True)
class Mesh:
    """The cells of a box in space and time.

    Attributes:
        edges: the edges of the cells of tau, from 0 to T in s, and of each state, in its unit.
        beyond: for each state, whether its lower and its upper side lie beyond a face of the target.
    """

    edges: list[np.ndarray]
    beyond: list[tuple[bool, bool]]

    @property
    def taus(self) -> np.ndarray:
        return self.edges[0]

    def nodes(self) -> np.ndarray:
        """The states (N, n) of the splines in space."""
        axes = [nodes_of(axis) for axis in self.edges[1:]]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))

    def at(self, x: np.ndarray) -> np.ndarray:
        """The values (P, N) of all splines in space at states (P, n)."""
        first, *others = (basis(axis, x[:, j]) for j, axis in enumerate(self.edges[1:]))
        for row in others:
            first = (first[:, :, None] * row[:, None, :]).reshape(len(x), -1)
        return first

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(axis) - 1 + DEGREE for axis in self.edges[1:])


def mesh_of(problem: ReachAvoidProblem, cells: int, steps: int) -> Mesh:
    """A mesh of the box of states with equal cells along each axis; a side that lies in the target is moved outward."""
    box, edges, beyond = problem.states, [problem.horizon * np.linspace(0, 1, steps + 1) ** GRADING], []
    for axis in range(box.dim):
        sides = [_in_target(problem, axis, end) for end in (box.low[axis], box.high[axis])]
        width = box.high[axis] - box.low[axis]
        low = box.low[axis] - BEYOND * width * sides[0]
        high = box.high[axis] + BEYOND * width * sides[1]
        edges.append(np.linspace(low, high, cells + 1))
        beyond.append((sides[0], sides[1]))
    return Mesh(edges, beyond)


def _in_target(problem: ReachAvoidProblem, axis: int, end: float) -> bool:
    """Whether the side of the box of states lies in A."""
    if problem.objective == "invariance":
        return False
    x = problem.states.sample(256, torch.Generator().manual_seed(0), torch.float64)
    x[:, axis] = end
    return bool((problem.reached_constraints(x) <= 1e-9).all())
