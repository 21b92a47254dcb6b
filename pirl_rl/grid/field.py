"""V between the nodes of one mesh, and which cells the faces of A and B cut."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.grid.mesh import Mesh, absorbed
from pirl_rl.problem import ReachAvoidProblem

ROUNDING = 1e-4
"""The share of the horizon by which tau may exceed it, because tau may be rounded to float32."""


class Field:
    """V, multilinear in x and linear in sqrt(tau) between the nodes.

    In every method tau is (P,), in s, and x is (P, n), in SI units. Results have the dtype and the device of x.

    Args:
        problem: the physics.
        mesh: the nodes.
        values: V (steps + 1, N) at tau = horizon * (k / steps)^2. At nodes in A and B it is continued from outside, so
            that the interpolated V takes the value of the set at its face.
    """

    def __init__(self, problem: ReachAvoidProblem, mesh: Mesh, values: np.ndarray):
        self.problem, self.mesh, self.values = problem, mesh, values

    def __call__(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (P,), continued into A and B.

        Raises:
            ArgumentError: a tau is outside [0, horizon].
        """
        result = np.zeros(len(x))
        for time, node, weight in self.corners(tau, x):
            result += weight * self.values[time, node]
        return torch.from_numpy(result).to(x)

    def corners(self, tau: Tensor, x: Tensor) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Time level, node and weight, each (P,), of every point that the interpolation uses.

        Raises:
            ArgumentError: a tau is outside [0, horizon].
        """
        level = self._level(tau)
        before = np.floor(level).astype(int).clip(0, len(self.values) - 2)
        share = level - before
        nodes, weights = self.mesh.corners(x.detach().double().cpu().numpy())
        for node, weight in zip(nodes, weights, strict=True):
            yield before, node, weight * (1 - share)
            yield before + 1, node, weight * share

    def nearest(self, tau: Tensor, x: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Time level and node, each (P,), of the point that has the largest weight in the interpolation.

        Raises:
            ArgumentError: a tau is outside [0, horizon].
        """
        return np.ceil(self._level(tau) - 0.5).astype(int), self.mesh.nearest(x.detach().double().cpu().numpy())

    def _level(self, tau: Tensor) -> np.ndarray:
        """The place of tau among the time levels, (P,)."""
        horizon, last = self.problem.horizon, len(self.values) - 1
        if not bool(((tau >= 0) & (tau <= horizon * (1 + ROUNDING))).all()):
            raise ArgumentError(f"tau: expected 0 <= tau <= horizon = {horizon}, got {tau.min()} to {tau.max()}")
        return last * np.sqrt((tau.double().cpu().numpy() / horizon).clip(0, 1))

    def uncut(self, x: Tensor) -> Tensor:
        """Whether all corners of the cells around the states lie outside A and B, (P,) bool."""
        return ~self._any_corner(self._absorbed, x)

    def near_faces(self, x: Tensor) -> Tensor:
        """Whether a face cuts the cells around the states or one of the cells beside them, (P,) bool."""
        return self._any_corner(self._near_absorbed, x)

    def _any_corner(self, nodes: np.ndarray, x: Tensor) -> Tensor:
        """Whether a corner of the cells around the states is one of the nodes (N,) bool, (P,) bool."""
        corners, _ = self.mesh.corners(x.detach().double().cpu().numpy())
        return torch.from_numpy(nodes[corners].any(0)).to(x.device)

    @cached_property
    def _absorbed(self) -> np.ndarray:
        """Which nodes lie in A or B, (N,) bool."""
        return absorbed(self.problem, self.mesh.states(self.mesh.indices()))[0]

    @cached_property
    def _near_absorbed(self) -> np.ndarray:
        """Which nodes lie in A or B or beside a node that does, (N,) bool."""
        modes = ["wrap" if axis in self.mesh.periodic else "nearest" for axis in range(len(self.mesh.shape))]
        near = maximum_filter(self._absorbed.reshape(self.mesh.shape), size=3, mode=modes)  # type: ignore[arg-type]
        return near.ravel()
