"""The mesh: equidistant nodes of a box around `problem.states`, and which of them lie in A or B.

The box is wider than `states` on every axis that is not periodic, because paths leave `states` and return, and then cut
down to the nodes outside A and B with one layer around them. Beyond the mesh the chain is put back on its edge.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem

DEVIATIONS = 3.0
"""Number of standard deviations by which the box is widened. A path that goes so far and comes back covers six."""

WIDEST = {1: 1.0, 2: 1.0, 3: 0.5}
"""The largest margin on a side, in widths of `states`, by the number of states: in three dimensions it costs most."""

WIDER = {1: 10.0, 2: 2.0, 3: 2.0}
"""The largest margin of the mesh with which V is compared where the margin was limited, in units of the limited one."""

LEAST_ACROSS = 4
"""The least number of nodes in a row in the target along each axis with which an estimate of the error is trusted.

With half the points two of them are left. A solution with fewer can be as wrong as that with half the points, so that
their difference is small and says nothing.
"""


class Mesh:
    """Equidistant nodes, ordered with the last axis fastest.

    Meshes with the same origin and spacing have the same nodes to the last bit where they overlap, so that a node on a
    face of A or B is on the same side of it in both.

    Args:
        origin: a point of the lattice (n,), in SI units.
        spacing: distance of neighbours along each axis (n,), in SI units.
        shape: number of nodes along each axis (n,).
        periodic: axes along which the first node follows the last one.
        first: whole number of nodes from the origin to the first one, along each axis (n,).
    """

    def __init__(
        self,
        origin: np.ndarray,
        spacing: np.ndarray,
        shape: Sequence[int],
        periodic: Sequence[int] = (),
        first: np.ndarray | int = 0,
    ):
        self.origin, self.spacing = origin, spacing
        self.first = np.broadcast_to(first, origin.shape)
        self.shape = tuple(int(count) for count in shape)
        self.periodic = tuple(periodic)

    @property
    def low(self) -> np.ndarray:
        """The first node (n,), in SI units."""
        return self.origin + self.spacing * self.first

    @property
    def size(self) -> int:
        """The number of nodes N."""
        return int(np.prod(self.shape))

    def indices(self) -> np.ndarray:
        """The indices (N, n) of all nodes along the axes."""
        return np.indices(self.shape).reshape(len(self.shape), -1).T

    def states(self, indices: np.ndarray) -> np.ndarray:
        """The states (*, n) at indices (*, n), which need not be whole; periodic axes are wrapped."""
        indices = indices.astype(float)
        for axis in self.periodic:
            indices[..., axis] %= self.shape[axis]
        return self.origin + self.spacing * (self.first + indices)

    def flat(self, indices: np.ndarray) -> np.ndarray:
        """The numbers (*) of the nodes at whole indices (*, n), wrapped or put on the edge."""
        modes = ["wrap" if axis in self.periodic else "clip" for axis in range(len(self.shape))]
        return np.ravel_multi_index(tuple(np.moveaxis(indices, -1, 0)), self.shape, mode=tuple(modes))  # type: ignore[arg-type]

    def corners(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Multilinear interpolation at states (P, n): numbers (2^n, P) of nodes and their weights (2^n, P)."""
        position = self._position(x)
        base = np.floor(position)
        share = position - base
        offsets = np.indices((2,) * len(self.shape)).reshape(len(self.shape), -1).T[:, None]
        weights = np.where(offsets == 1, share, 1 - share).prod(-1)
        return self.flat(base.astype(int) + offsets), weights

    def nearest(self, x: np.ndarray) -> np.ndarray:
        """The number (P,) of the node that has the largest weight in the interpolation at states (P, n)."""
        return self.flat(np.ceil(self._position(x) - 0.5).astype(int))

    def _position(self, x: np.ndarray) -> np.ndarray:
        """The coordinates of states (P, n) in distances of two nodes from the first one, within the mesh."""
        position = (x - self.low) / self.spacing
        for axis in set(range(len(self.shape))) - set(self.periodic):
            position[:, axis] = position[:, axis].clip(0, self.shape[axis] - 1)
        return position


def absorbed(problem: ReachAvoidProblem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether states (P, n) are in A or B (P,) bool, and the value there (P,): 1 in A, 0 in B and elsewhere."""
    points = torch.from_numpy(x)
    reached, failed = problem.reached(points).numpy(), problem.failed(points).numpy()
    return reached | failed, (reached & ~failed).astype(float)


def finite(values: torch.Tensor) -> np.ndarray:
    """The values, with 0 in place of those that are not finite, as the physics may have no numbers at some states."""
    return np.nan_to_num(values.numpy(), nan=0.0, posinf=0.0, neginf=0.0)


def widest_margin(problem: ReachAvoidProblem) -> np.ndarray:
    """The largest margin (n,) that is chosen, in SI units, see `WIDEST`."""
    return WIDEST[problem.states.dim] * (np.array(problem.states.high) - problem.states.low)


def default_margin(problem: ReachAvoidProblem, samples: int = 4096) -> np.ndarray:
    """How far (n,) the box should be widened on each side, in SI units, from drift and noise at sampled states.

    It is the way that the drift goes out and back within the horizon and `DEVIATIONS` standard deviations of the noise,
    and 0 on periodic axes. The mesh goes as far, but at most by `widest_margin`. States without finite drift and noise,
    as inside a set, do not count.
    """
    rng = torch.Generator().manual_seed(0)
    x = problem.states.sample(samples, rng, torch.float64)
    u = problem.controls.sample(samples, rng, torch.float64)
    speed = finite(problem.drift(x, u).abs()).max(0)
    noise = finite(problem.diffusion(x, u).norm(dim=-1)).max(0)
    margin = speed * problem.horizon / 2 + DEVIATIONS * noise * problem.horizon**0.5
    margin[list(problem.states.periodic)] = 0.0
    return margin


def make_mesh(problem: ReachAvoidProblem, points: Sequence[int], margin: np.ndarray) -> Mesh:
    """The mesh with `points` nodes across `states` along each axis, widened by `margin` (n,) on each side, then cut.

    Raises:
        ArgumentError: every node lies in A or B.
    """
    wide = _wide(problem, points, margin)
    free = ~absorbed(problem, wide.states(wide.indices()))[0].reshape(wide.shape)
    if not free.any():
        raise ArgumentError(f"points: expected nodes outside of target and avoid set, got none with points={points}")
    axes = range(len(wide.shape))
    first, last = np.zeros(len(axes), int), np.array(wide.shape) - 1
    for axis in set(axes) - set(wide.periodic):
        inside = np.flatnonzero(free.any(tuple(other for other in axes if other != axis)))
        first[axis], last[axis] = max(inside[0] - 1, 0), min(inside[-1] + 1, last[axis])
    return Mesh(wide.origin, wide.spacing, (last - first + 1).tolist(), wide.periodic, wide.first + first)


def resolves_target(problem: ReachAvoidProblem, points: Sequence[int], margin: np.ndarray) -> bool:
    """Whether A has `LEAST_ACROSS` nodes in a row along each axis, on the mesh of `make_mesh` before it is cut.

    A target that reaches the edge of that mesh counts as one that goes on beyond it. Without a target there is nothing
    to resolve.

    Args:
        problem: the physics.
        points: the numbers of nodes across `problem.states` along each axis.
        margin: how far the mesh goes beyond `problem.states` on each side (n,), in SI units.
    """
    if problem.objective != "reach-avoid":
        return True
    wide = _wide(problem, points, margin)
    target = absorbed(problem, wide.states(wide.indices()))[1].reshape(wide.shape) > 0
    for axis in range(target.ndim):
        ends = [(LEAST_ACROSS - 1,) * 2 if other == axis else (0, 0) for other in range(target.ndim)]
        continued = np.pad(target, ends, mode="wrap" if axis in wide.periodic else "edge")
        if not sliding_window_view(continued, LEAST_ACROSS, axis).all(-1).any():
            return False
    return True


def _wide(problem: ReachAvoidProblem, points: Sequence[int], margin: np.ndarray) -> Mesh:
    """The mesh with `points` nodes across `states` along each axis, widened by `margin` (n,) on each side."""
    low, width = np.array(problem.states.low), np.array(problem.states.high) - problem.states.low
    periodic, count = tuple(problem.states.periodic), np.array(points)
    spacing = width / np.where(np.isin(np.arange(len(low)), periodic), count, count - 1)
    extra = np.ceil(margin / spacing - 1e-9).astype(int)
    return Mesh(low, spacing, (count + 2 * extra).tolist(), periodic, -extra)
