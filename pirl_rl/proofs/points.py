"""States at which W meets conditions, with the matrices of its values and of L^pi."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.mesh import Mesh
from pirl_rl.proofs.spline import design

Policy = Callable[[Tensor, Tensor], Tensor]
"""Maps tau (N,) and x (N, n), float64, to the control (N, m) in SI units."""


class Points:
    """States (N, n) with the matrices that give W, its slopes and its curvatures there from the coefficients."""

    def __init__(self, problem: ReachAvoidProblem, policy: Policy, mesh: Mesh, x: np.ndarray):
        self.problem, self.policy, self.x = problem, policy, x
        axes = range(len(mesh.space))
        self.values = design(mesh.space, x)
        self.slopes = [design(mesh.space, x, [i]) for i in axes]
        self.curvatures = {(i, j): design(mesh.space, x, [i, j]) for i in axes for j in axes if i <= j}

    def rates(self, tau: float) -> tuple[np.ndarray, np.ndarray]:
        """The drift (N, n) and sigma sigma^T (N, n, n) under the policy at a time to go."""
        x = torch.from_numpy(self.x)
        u = self.policy(torch.full((len(x),), tau, dtype=torch.float64), x)
        sigma = self.problem.diffusion(x, u)
        return self.problem.drift(x, u).numpy(), (sigma @ sigma.mT).numpy()

    def operator(self, tau: float) -> Any:
        """The matrix of f . grad + 1/2 Tr(sigma sigma^T hess) at a time to go."""
        f, a = self.rates(tau)
        result: Any = sum(sp.diags(f[:, i]) @ slope for i, slope in enumerate(self.slopes))
        for (i, j), curvature in self.curvatures.items():
            if a[:, i, j].any():
                result = result + sp.diags(a[:, i, j] * (0.5 if i == j else 1.0)) @ curvature
        return result.tocsr()
