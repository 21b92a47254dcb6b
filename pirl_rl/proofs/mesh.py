"""The mesh of a proof: cells in space and time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pirl_rl.proofs.ends import Ends
from pirl_rl.proofs.spline import DEGREE

TIME_GRADING = 1.5
"""Levels of tau are (k / steps)^TIME_GRADING T, closer where W rises from its values at tau = 0."""

BEYOND = 0.05
"""The share of the width of the box by which a side that lies in the target is moved outward, so that it is inside."""

COVERED = 1e-10
"""The share of the width of the box by which a side on the face of B is moved outward, so that it is surely in B."""

EXTENSION = 1.5
"""The share of the width of the box by which a side moves outward for an upper bound, where paths may leave the box.

Paths that leave the mesh count as successes there, and few of those that start in the box come so far.
"""

GROWTH = 1.15
"""The ratio of the widths of neighbouring cells beyond the box, at most."""

GAUSS = ((1 - 3**-0.5) / 2, (1 + 3**-0.5) / 2)
"""The places of two Gauss points in a cell [0, 1]."""

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

    def widths_at(self, x: np.ndarray) -> np.ndarray:
        """The widths (P, n) of the cells of states (P, n) along each axis."""
        return np.stack([np.diff(axis)[cell] for axis, cell in zip(self.space, self.cell_of(x), strict=True)], -1)

    def places_of(self, x: np.ndarray) -> np.ndarray:
        """States (P, n) in coordinates in which each cell has the width 1."""
        return np.stack([np.interp(x[:, j], axis, np.arange(len(axis))) for j, axis in enumerate(self.space)], -1)

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


def mesh_of(ends: Ends, cells: int, steps: int) -> Mesh:
    """A mesh of the box of states with `cells` along each axis and `steps` along tau.

    A side that lies in the target is moved outward. For a bound of failures, a side that A and B cover is moved by as
    much as rounding needs, and cells that grow are added beyond a side that they do not cover.
    """
    s = np.linspace(-1, 1, cells + 1)
    s = (1 - GRADING) * s + GRADING * np.sin(np.pi / 2 * s)
    s[[0, -1]] = -1, 1
    problem = ends.problem
    edges, box = [problem.horizon * np.linspace(0, 1, steps + 1) ** TIME_GRADING], problem.states
    for j, (low, high) in enumerate(zip(box.low, box.high, strict=True)):
        width, beyond = high - low, [_beyond(ends, j, end) for end in (low, high)]
        near = [0.0 if share == EXTENSION else share * width for share in beyond]
        low, high = low - near[0], high + near[1]
        axis = (low + high) / 2 + (high - low) / 2 * s
        axis[[0, -1]] = low, high
        if beyond[0] == EXTENSION:
            axis = np.concatenate([low - _growing(axis[1] - low, EXTENSION * width)[::-1], axis])
        if beyond[1] == EXTENSION:
            axis = np.concatenate([axis, high + _growing(high - axis[-2], EXTENSION * width)])
        edges.append(axis)
    return Mesh(edges)


def _beyond(ends: Ends, axis: int, end: float) -> float:
    """The share of the width of the box by which a side is moved outward."""
    x = ends.problem.states.sample(256, torch.Generator().manual_seed(0), torch.float64)
    x[:, axis] = end
    reached = ends.in_target(x)
    if reached.all():
        return BEYOND
    if ends.success:
        return 0.0
    if not (reached | ends.in_avoid(x)).all():
        return EXTENSION
    return BEYOND if ends.has_rounded_avoid else COVERED


def _growing(first: float, length: float) -> np.ndarray:
    """The distances (k,) from a side of the edges of cells beyond it, up to a length."""
    count = math.ceil(math.log(1 + (GROWTH - 1) * length / first) / math.log(GROWTH))
    ends = np.cumsum(GROWTH ** np.arange(1, count + 1))
    return length * ends / ends[-1]
