"""A function below a probability: a spline W with L^pi W = m >= 0, and W at most what is paid where paths end.

W solves the linear HJB equation of a policy, Eq. (linear_pde), with a source m that lowers it: level by level of tau by
the trapezoidal rule, and in space by least squares at two Gauss points of each cell along each axis. Least squares are
stable where there is no noise and at faces, where the equations of collocation oscillate. What is proved does not
depend on how W was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from scipy.interpolate import make_interp_spline

from pirl_rl.proofs.boundary import Boundary, smoothstep
from pirl_rl.proofs.ends import Ends
from pirl_rl.proofs.faces import cells_from
from pirl_rl.proofs.mesh import GAUSS, Mesh, product
from pirl_rl.proofs.normal import NormalEquations
from pirl_rl.proofs.points import Points
from pirl_rl.proofs.rates import Policy, controls_at
from pirl_rl.proofs.spline import DEGREE, Spline, design

WIDTH = 0.15
"""At tau = 0 W falls to 0 towards the face of B over this share of the depth of the safe set at least."""

CELLS = 4
"""At tau = 0 W falls to 0 towards faces over this number of cells at least."""

FAR = 0.6
"""At tau = 0 W falls to 0 towards sides that lie beyond the box of states over this share of their distance to it."""

FIRST_STEPS = 4
"""The number of first steps in time that are implicit, which damp what the trapezoidal rule does not."""

FACE_WEIGHT = 30.0
"""The weight of the values on faces in the least squares, where an equation of the interior has 1."""

SMOOTHING = 1e-3
"""The weight of the third differences of the coefficients, which continue W smoothly into A and B."""


@dataclass(frozen=True)
class Step:
    """The least squares of one step in time.

    Attributes:
        implicit: the share of the new level in the operator: 1, or 1/2 for the trapezoidal rule.
        operator: that of the new level at the points of the interior.
        ends: where W is given, the values (K,) at this time to go.
        normal: the normal equations of the new level.
    """

    implicit: float
    operator: Any
    ends: np.ndarray
    normal: NormalEquations


class Equation:
    """L^pi W = m with its conditions, on a mesh.

    Args:
        ends: the problem, and what W may be where paths end.
        policy: the control.
        mesh: the mesh.
    """

    def __init__(self, ends: Ends, policy: Policy, mesh: Mesh):
        self.ends, self.policy, self.mesh = ends, policy, mesh
        x = product(mesh.points(GAUSS))
        self.boundary = Boundary(ends, policy, mesh, x)
        self.points = Points(ends.problem, mesh, x[~self.boundary.given(x)])
        self._smoothing = SMOOTHING * _third_differences(mesh.shape)
        self._start = self._start_from(x)
        self._steps = [self._step(k) for k in range(1, len(mesh.taus))]

    def solve(self, source: np.ndarray) -> Spline:
        """W for a source m (levels of tau, N) >= 0 at the points, in 1/s."""
        taus, rows = self.mesh.taus, [self._start]
        for k, step in enumerate(self._steps, 1):
            length, new = taus[k] - taus[k - 1], step.implicit
            right = self.points.values @ rows[-1] - length * (new * source[k] + (1 - new) * source[k - 1])
            if new < 1:
                right += (1 - new) * length * (self._steps[k - 2].operator @ rows[-1])
            right = np.concatenate([right, FACE_WEIGHT * step.ends, np.zeros(self._smoothing.shape[0])])
            rows.append(step.normal.solve(right))
        # make_interp_spline has no knots at the first and the last inner level. The spline that has all knots and the
        # same slopes at both ends is the same function.
        slopes = make_interp_spline(taus, np.array(rows), k=DEGREE)(taus[[0, -1]], nu=1)
        spline = make_interp_spline(taus, np.array(rows), k=DEGREE, bc_type=([(1, slopes[0])], [(1, slopes[1])]))
        return Spline(self.mesh.edges, spline.c.reshape(-1, *self.mesh.shape))

    def _step(self, k: int) -> Step:
        """The equations from level k - 1 to level k, and what is given there."""
        taus, new = self.mesh.taus, 1.0 if k <= FIRST_STEPS else 0.5
        operator = self.points.operator(self.points.factors(controls_at(self.policy, taus[k], self.points)))
        interior = self.points.values - new * (taus[k] - taus[k - 1]) * operator
        given, ends = self.boundary.at(taus[k])
        rows = sp.vstack([interior, FACE_WEIGHT * given, self._smoothing]).tocsr()
        return Step(new, operator, ends, NormalEquations(rows))

    def _start_from(self, x: np.ndarray) -> np.ndarray:
        """The coefficients (N,) of W at tau = 0, from its values at points (P, n)."""
        if self.ends.at_start == 0:
            return np.zeros(self.points.values.shape[1])
        values = self._ramp_to_sides(x)
        if self.ends.at_avoid == 1:
            values[self.ends.in_avoid(torch.from_numpy(x)).numpy()] = 1.0
        if self.ends.has_target and self.ends.at_target == 0:
            # In A all levels are <= 0, so that no factor is below 1.
            away = cells_from(self.ends.target, self.mesh, x)
            values *= 1 - (1 - smoothstep(away / CELLS)).prod(-1)
        if self.ends.problem.has_avoid_set and self.ends.at_avoid == 0:
            levels = self.ends.avoid(torch.from_numpy(x)).numpy()
            # The depth is about half of the box.
            width = max(WIDTH, 2 * CELLS / min(self.mesh.cells[1:]))
            values *= smoothstep(levels / (width * levels.max(0))).prod(-1)
        rows = sp.vstack([design(self.mesh.space, x), self._smoothing]).tocsr()
        right = np.concatenate([values, np.zeros(self._smoothing.shape[0])])
        return NormalEquations(rows).solve(right)

    def _ramp_to_sides(self, x: np.ndarray) -> np.ndarray:
        """A function (P,) that falls from 1 in the box of states to 0 on those sides of the mesh that lie beyond it."""
        result, box = np.ones(len(x)), self.ends.problem.states
        for j in range(x.shape[1]):
            for end, side in ((box.low[j], self.mesh.low[j]), (box.high[j], self.mesh.high[j])):
                if side != end:
                    result *= smoothstep((x[:, j] - side) / (FAR * (end - side)))
        return result


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
