"""Drift equilibria of the single-track model on a path of constant curvature, as functions of friction."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import root
from torch import Tensor

from pirl_rl.constants import Constant
from pirl_rl.problems.drift.vehicle import accelerations

DEGREE = math.pi / 180
SPEED = 8.0  # m/s, v_x of the equilibria
CURVATURE = 0.600 * math.cos(-20.44 * DEGREE) / SPEED  # 1/m, of the path
FRICTION_BAND = (0.5, 0.6)  # the friction coefficients whose equilibria are targets
KNOTS = 513  # of the interpolated curves over this band


def equilibrium(friction: float) -> tuple[np.ndarray, np.ndarray]:
    """The drift equilibrium at a friction coefficient.

    v_x = 8 m/s, e_y = 0 and e_psi = -beta are given, and the car follows the path if r = curvature v_x / cos(beta). A
    root finder solves v_x' = v_y' = r' = 0 for beta, delta and F_x.

    Returns:
        The state (e_y, e_psi, v_x, v_y, r, delta, mu) (7,) and the control (delta', F_x) (2,), in SI units.

    Raises:
        ArithmeticError: the root finder does not converge.
    """

    def point(unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        beta, delta, force = unknown
        v_y, r = SPEED * math.tan(beta), CURVATURE * SPEED / math.cos(beta)
        return np.array([0.0, -beta, SPEED, v_y, r, delta, friction]), np.array([0.0, 1000 * force])

    def residual(unknown: np.ndarray) -> np.ndarray:
        x, u = (torch.from_numpy(entry) for entry in point(unknown))
        return torch.stack(accelerations(x[2], x[3], x[4], x[5], x[6], u[1])).numpy()

    found = root(residual, [-20.44 * DEGREE, -12 * DEGREE, 2.293], tol=1e-14)
    if np.abs(found.fun).max() > 1e-9:
        raise ArithmeticError(
            f"no drift equilibrium found at friction {friction}: expected residuals <= 1e-9, got {found.fun}"
        )
    return point(found.x)


class EquilibriumCurves:
    """beta, r and delta (*), in rad, rad/s and rad, of the equilibrium at friction (*), clamped to the band.

    They are interpolated linearly between knots, with errors of at most 3e-7: the rear tyre slides in the whole band,
    so the curves are smooth.
    """

    def __init__(self):
        # Solved here, because the first call may be inside a transform of torch.func, where scipy cannot be used.
        self._table = Constant(_table())

    def __call__(self, friction: Tensor) -> tuple[Tensor, ...]:
        low, high = FRICTION_BAND
        position = ((friction - low) * ((KNOTS - 1) / (high - low))).clamp(0, KNOTS - 1)
        knot = position.long().clamp(max=KNOTS - 2)
        table = self._table.like(friction)
        return torch.lerp(table[knot], table[knot + 1], (position - knot).unsqueeze(-1)).unbind(-1)


@cache
def _table() -> np.ndarray:
    """beta, r and delta at equidistant frictions of the band, (KNOTS, 3).

    Only every eighth equilibrium is solved, and a cubic spline gives the others, with errors of 3e-8. This takes tenths
    of a second in place of seconds.
    """
    knots = np.linspace(*FRICTION_BAND, KNOTS)
    solved = np.stack([equilibrium(friction)[0] for friction in knots[::8]])
    return CubicSpline(knots[::8], solved[:, [1, 4, 5]] * [-1, 1, 1])(knots)
