"""A function below the value of a policy: the spline W with L^pi W = m >= 0 that is 0 where paths end in failure.

W solves the linear HJB equation of the policy, Eq. (linear_pde), with a source m that lowers it, by collocation of
splines in space and the trapezoidal rule in time. Where L^pi W >= 0 fails between the nodes, m is raised and W solved
again. What is proved does not depend on how W was found.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from scipy.interpolate import make_interp_spline
from scipy.sparse.linalg import splu
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.mesh import Mesh
from pirl_rl.proofs.spline import DEGREE, Spline, basis, nodes_of
from pirl_rl.proofs.target import continuation_rows

RAMP = 0.1
"""The share of the horizon in which W rises at the target from 0 to 1, without which it would jump at tau = 0."""

WIDTH = 0.15
"""The share of the depth of the safe set over which W falls to 0 towards its faces at tau = 0."""

FIRST_STEPS = 4
"""The number of first steps in time that are implicit, which damp what the trapezoidal rule does not."""

Policy = Callable[[Tensor, Tensor], Tensor]


class Equation:
    """L^pi W = m with its conditions, on the nodes of a mesh.

    Args:
        problem: the physics.
        policy: maps tau (N,) and x (N, n), float64, to the control (N, m) in SI units.
        mesh: the mesh.
    """

    def __init__(self, problem: ReachAvoidProblem, policy: Policy, mesh: Mesh):
        self.problem, self.mesh, self.x = problem, mesh, mesh.nodes()
        x = torch.from_numpy(self.x)
        self._drift, self._variance = [], []
        for tau in mesh.taus:
            u = policy(torch.full((len(x),), tau, dtype=torch.float64), x)
            sigma = problem.diffusion(x, u)
            self._drift.append(problem.drift(x, u).numpy())
            self._variance.append((sigma @ sigma.mT).numpy())
        reach = problem.objective == "reach-avoid"
        self._target = problem.reached(x).numpy() if reach else np.zeros(len(x), bool)
        self._continued, self._faces = continuation_rows(problem, mesh, self._target)
        self._zero = [self._ends_in_failure(k) for k in range(len(mesh.taus))]
        self._values, self._slopes, self._curvatures = self._matrices()

    def solve(self, source: np.ndarray) -> Spline:
        """W for a source m (levels of tau, N) >= 0, in 1/s."""
        taus = self.mesh.taus
        rows, before = [self._inverse(0, self._values, self._start())], self._operator(0)
        for k in range(1, len(taus)):
            step, after = taus[k] - taus[k - 1], self._operator(k)
            share = 1.0 if k <= FIRST_STEPS else 0.5
            right = (self._values + (1 - share) * step * before) @ rows[-1]
            right -= step * (share * source[k] + (1 - share) * source[k - 1])
            right[self._zero[k]] = 0.0
            right[self._target] = 0.0
            right[self._faces] = smoothstep(taus[k] / (RAMP * self.problem.horizon))
            rows.append(self._inverse(k, self._values - share * step * after, right))
            before = after
        ends = [[(1, self._rate(k, rows[k], source[k]))] for k in (0, -1)]
        spline = make_interp_spline(taus, np.array(rows), k=DEGREE, bc_type=(ends[0], ends[1]))
        return Spline(self.mesh.edges, spline.c.reshape(-1, *self.mesh.shape))

    def _start(self) -> np.ndarray:
        """W (N,) at tau = 0."""
        if self.problem.objective == "reach-avoid":
            return np.zeros(len(self.x))
        levels = self.problem.avoid_constraints(torch.from_numpy(self.x)).numpy()
        return smoothstep(levels / (WIDTH * levels.max(0))).prod(-1)

    def _ends_in_failure(self, k: int) -> np.ndarray:
        """The nodes (N,) in B, and those in sides of the mesh that paths cross outward, at a level of tau."""
        x, f, a = self.x, self._drift[k], self._variance[k]
        result = self.problem.failed(torch.from_numpy(x)).numpy() & ~self._target
        for axis, (edges, beyond) in enumerate(zip(self.mesh.edges[1:], self.mesh.beyond, strict=True)):
            for end, outward, in_target in ((edges[0], -1, beyond[0]), (edges[-1], 1, beyond[1])):
                side = np.isclose(x[:, axis], end, rtol=0, atol=1e-12) & ~self._target
                crossed = (a[:, axis, axis] > 0) | (outward * f[:, axis] >= 0)
                result = np.where(side, crossed & (not in_target), result)
        return result

    def _matrices(self) -> tuple[Any, list[Any], dict[tuple[int, int], Any]]:
        """The values, first and second derivatives in space of all splines at the nodes."""
        axes = self.mesh.edges[1:]
        tables = [[sp.csr_matrix(basis(axis, nodes_of(axis), order)) for order in range(3)] for axis in axes]

        def product(*derived: int) -> Any:
            result = tables[0][derived.count(0)]
            for j in range(1, len(axes)):
                result = sp.kron(result, tables[j][derived.count(j)], format="csr")
            return result

        n = range(len(axes))
        return product(), [product(i) for i in n], {(i, j): product(i, j) for i in n for j in n if i <= j}

    def _operator(self, k: int) -> Any:
        """f . grad + 1/2 Tr(sigma sigma^T hess) at the nodes, at a level of tau."""
        f, a = self._drift[k], self._variance[k]
        result = sum(sp.diags(f[:, i]) @ slope for i, slope in enumerate(self._slopes))
        for (i, j), curvature in self._curvatures.items():
            result = result + sp.diags(a[:, i, j] * (0.5 if i == j else 1.0)) @ curvature
        return result

    def _inverse(self, k: int, left: Any, right: np.ndarray) -> np.ndarray:
        """The coefficients that solve `left` at free nodes, and have the given values at all others."""
        kind = np.where(self._target, 2, np.where(self._zero[k], 1, 0))
        parts = (left, self._values, self._continued)
        rows: Any = sum(sp.diags((kind == i).astype(float)) @ part for i, part in enumerate(parts))
        return splu(rows.tocsc()).solve(right)

    def _rate(self, k: int, c: np.ndarray, source: np.ndarray) -> np.ndarray:
        """The derivative of the coefficients in tau at a level of tau at which the given values stand still."""
        right = (self._operator(k) @ c - source) * ~(self._zero[k] | self._target)
        return self._inverse(k, self._values, right)


def smoothstep(share: np.ndarray | float) -> np.ndarray:
    """The polynomial that rises from 0 at 0 to 1 at 1 with two vanishing derivatives at both."""
    z = np.clip(share, 0, 1)
    return z**3 * (10 - 15 * z + 6 * z**2)
