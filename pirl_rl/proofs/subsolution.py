"""A function below the value of a policy: a spline W with L^pi W = m >= 0 and W <= payoff where paths end.

W solves the linear HJB equation of the policy, Eq. (linear_pde), with a source m that lowers it: level by level of tau
by the trapezoidal rule, and in space by least squares at two Gauss points of each cell along each axis. Least squares
are stable where there is no noise and at faces, where the equations of collocation oscillate. What is proved does not
depend on how W was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from scipy.interpolate import make_interp_spline
from scipy.sparse.linalg import SuperLU, splu

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.faces import face_points, sides, smooth_target
from pirl_rl.proofs.mesh import Mesh, product
from pirl_rl.proofs.points import Points, Policy
from pirl_rl.proofs.spline import DEGREE, Spline, design

RAMP = 0.1
"""The share of the horizon in which W rises at the target from 0 to 1, without which it would jump at tau = 0."""

WIDTH = 0.15
"""At tau = 0 W falls to 0 towards the face of B over this share of the depth of the safe set at least."""

CELLS = 4
"""At tau = 0 W falls to 0 towards faces over this number of cells at least."""

FIRST_STEPS = 4
"""The number of first steps in time that are implicit, which damp what the trapezoidal rule does not."""

FACE_WEIGHT = 30.0
"""The weight of the values on faces in the least squares, where an equation of the interior has 1."""

SMOOTHING = 1e-3
"""The weight of the third differences of the coefficients, which continue W smoothly into A and B."""

GAUSS = ((1 - 3**-0.5) / 2, (1 + 3**-0.5) / 2)
"""The places of two Gauss points in a cell [0, 1]."""


@dataclass(frozen=True)
class Step:
    """The least squares of one step in time.

    Attributes:
        implicit: the share of the new level in the operator: 1, or 1/2 for the trapezoidal rule.
        rows: the matrix (equations, N).
        normal: the factors of its normal equations.
    """

    implicit: float
    rows: Any
    normal: SuperLU


class Equation:
    """L^pi W = m with its conditions, on a mesh.

    Args:
        problem: the physics.
        policy: the policy.
        mesh: the mesh.
    """

    def __init__(self, problem: ReachAvoidProblem, policy: Policy, mesh: Mesh):
        self.problem, self.mesh = problem, mesh
        x = product(mesh.points(GAUSS))
        target = avoid = np.zeros((0, x.shape[1]))
        if problem.objective == "reach-avoid":
            self._level = smooth_target(problem, torch.from_numpy(x))
            target = face_points(self._level, mesh, x)
        if problem.has_avoid_set:
            avoid = face_points(lambda points: problem.avoid_constraints(points).amin(-1), mesh, x)
            avoid = avoid[((avoid > mesh.low) & (avoid < mesh.high)).all(-1)]  # the others are those of the sides
        ends, self._axis, self._outward = sides(problem, mesh, GAUSS)
        self.points, self._ends = Points(problem, policy, mesh, x[~self.given(x)]), Points(problem, policy, mesh, ends)
        self._target, self._avoid = design(mesh.space, target), design(mesh.space, avoid)
        self._smoothing = SMOOTHING * _third_differences(mesh.shape)
        self._operators = [self.points.operator(tau) for tau in mesh.taus]
        self._steps = [self._step(k) for k in range(1, len(mesh.taus))]
        self._start = self._start_from(x)

    def given(self, x: np.ndarray) -> np.ndarray:
        """Whether states (N, n) are in B, or in the smooth part of A."""
        states = torch.from_numpy(x)
        ended = self.problem.failed(states)
        if self.problem.objective == "reach-avoid":
            ended = ended | (self._level(states) <= 0)
        return ended.numpy()

    def solve(self, source: np.ndarray) -> Spline:
        """W for a source m (levels of tau, N) >= 0 at the points, in 1/s."""
        taus, rows = self.mesh.taus, [self._start]
        for k, step in enumerate(self._steps, 1):
            length, new = taus[k] - taus[k - 1], step.implicit
            right = self.points.values @ rows[-1] + (1 - new) * length * (self._operators[k - 1] @ rows[-1])
            right -= length * (new * source[k] + (1 - new) * source[k - 1])
            reached = FACE_WEIGHT * smoothstep(taus[k] / (RAMP * self.problem.horizon))
            zeros = np.zeros(step.rows.shape[0] - len(right) - self._target.shape[0])
            right = np.concatenate([right, np.full(self._target.shape[0], reached), zeros])
            rows.append(step.normal.solve(step.rows.T @ right))
        # make_interp_spline has no knots at the first and the last inner level. The spline that has all knots and the
        # same slopes at both ends is the same function.
        slopes = make_interp_spline(taus, np.array(rows), k=DEGREE)(taus[[0, -1]], nu=1)
        spline = make_interp_spline(taus, np.array(rows), k=DEGREE, bc_type=([(1, slopes[0])], [(1, slopes[1])]))
        return Spline(self.mesh.edges, spline.c.reshape(-1, *self.mesh.shape))

    def _step(self, k: int) -> Step:
        """The equations from level k - 1 to level k: of the interior, of A, and those with the value 0."""
        taus, new = self.mesh.taus, 1.0 if k <= FIRST_STEPS else 0.5
        interior = self.points.values - new * (taus[k] - taus[k - 1]) * self._operators[k]
        crossed = self._ends.values[self._crossed(taus[k])]
        given = [FACE_WEIGHT * matrix for matrix in (self._target, self._avoid, crossed)]
        rows = sp.vstack([interior, *given, self._smoothing]).tocsr()
        symmetric = {"SymmetricMode": True}
        normal = splu((rows.T @ rows).tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=1e-3, options=symmetric)
        return Step(new, rows, normal)

    def _crossed(self, tau: float) -> np.ndarray:
        """Whether paths cross the sides of the box outward at their points: by noise, or along the drift."""
        f, a = self._ends.rates(tau)
        index = np.arange(len(f)), self._axis
        return (a[*index, self._axis] > 0) | (self._outward * f[index] >= 0)

    def _start_from(self, x: np.ndarray) -> np.ndarray:
        """The coefficients (N,) of W at tau = 0, from its values at points (P, n)."""
        if self.problem.objective == "reach-avoid":
            return np.zeros(self.points.values.shape[1])
        levels = self.problem.avoid_constraints(torch.from_numpy(x)).numpy()
        # The depth is about half of the box.
        width = max(WIDTH, 2 * CELLS / min(self.mesh.cells[1:]))
        values = smoothstep(levels / (width * levels.max(0))).prod(-1)
        rows = sp.vstack([design(self.mesh.space, x), self._smoothing]).tocsr()
        right = np.concatenate([values, np.zeros(self._smoothing.shape[0])])
        return splu((rows.T @ rows).tocsc()).solve(rows.T @ right)


def _third_differences(shape: tuple[int, ...]) -> Any:
    """The matrix (equations, N) of the third differences of coefficients along each axis."""
    parts = []
    for axis in range(len(shape)):
        factors = [sp.csr_matrix(np.diff(np.eye(n), 3, 0)) if i == axis else sp.eye(n) for i, n in enumerate(shape)]
        part = factors[0]
        for factor in factors[1:]:
            part = sp.kron(part, factor)
        parts.append(part)
    return sp.vstack(parts).tocsr()


def smoothstep(share: np.ndarray | float) -> np.ndarray:
    """The polynomial that rises from 0 at 0 to 1 at 1 with two vanishing derivatives at both."""
    z = np.clip(share, 0, 1)
    return z**3 * (10 - 15 * z + 6 * z**2)
