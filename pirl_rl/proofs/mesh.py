"""The mesh of a proof: cells in space and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.spline import DEGREE

TIME_GRADING = 1.5
"""Levels of tau are (k / steps)^TIME_GRADING T, closer where W rises from its values at tau = 0."""

BEYOND = 0.05
"""The share of the width of the box by which a side that lies in the target is moved outward, so that it is inside."""

NEAR = 1e-9
"""A point whose levels are below this lies in a set, as far as the mesh is concerned."""

GRADING = 0.4
"""The share of Chebyshev's spacing in that of the cells in space, which are smaller next to the sides of the box."""


@dataclass(frozen=True)
class Mesh:
    """The cells of a box in space and time.

    Attributes:
        edges: the edges of the cells of tau, from 0 to T in s, and of each state, in its unit.
    """

    edges: list[np.ndarray]

    @property
    def taus(self) -> np.ndarray:
        return self.edges[0]

    @property
    def space(self) -> list[np.ndarray]:
        """The edges along each state."""
        return self.edges[1:]

    @property
    def low(self) -> np.ndarray:
        """The lower corner (n,) of the box of states."""
        return np.array([axis[0] for axis in self.space])

    @property
    def high(self) -> np.ndarray:
        """The upper corner (n,) of the box of states."""
        return np.array([axis[-1] for axis in self.space])

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of splines along each state."""
        return tuple(len(axis) - 1 + DEGREE for axis in self.space)

    @property
    def cells(self) -> tuple[int, ...]:
        """The number of cells along tau and each state."""
        return tuple(len(axis) - 1 for axis in self.edges)

    def points(self, places: Sequence[float]) -> list[np.ndarray]:
        """Points along each state: at the given places of each cell, of which 0 and 1 are its edges."""
        return [np.unique((axis[:-1, None] + np.diff(axis)[:, None] * np.array(places)).ravel()) for axis in self.space]

    def cell_of(self, x: np.ndarray) -> tuple[np.ndarray, ...]:
        """The numbers of the cells in space of states (P, n), along each axis."""
        return tuple(
            np.clip(np.searchsorted(axis, x[:, j], side="right") - 1, 0, len(axis) - 2)
            for j, axis in enumerate(self.space)
        )


def product(axes: Sequence[np.ndarray]) -> np.ndarray:
    """All states (P, n) with coordinates out of the given ones."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))


def mesh_of(problem: ReachAvoidProblem, cells: int, steps: int) -> Mesh:
    """A mesh of the box of states with `cells` along each axis and `steps` along tau.

    A side that lies in the target is moved outward.
    """
    s = np.linspace(-1, 1, cells + 1)
    s = (1 - GRADING) * s + GRADING * np.sin(np.pi / 2 * s)
    s[[0, -1]] = -1, 1
    edges = [problem.horizon * np.linspace(0, 1, steps + 1) ** TIME_GRADING]
    box = problem.states
    for j, (low, high) in enumerate(zip(box.low, box.high, strict=True)):
        beyond = BEYOND * (high - low)
        low, high = low - beyond * _in_target(problem, j, low), high + beyond * _in_target(problem, j, high)
        axis = (low + high) / 2 + (high - low) / 2 * s
        axis[[0, -1]] = low, high
        edges.append(axis)
    return Mesh(edges)


def _in_target(problem: ReachAvoidProblem, axis: int, end: float) -> bool:
    """Whether the side of the box of states lies in A."""
    if problem.objective == "invariance":
        return False
    x = problem.states.sample(256, torch.Generator().manual_seed(0), torch.float64)
    x[:, axis] = end
    return bool((problem.reached_constraints(x) <= NEAR).all())
