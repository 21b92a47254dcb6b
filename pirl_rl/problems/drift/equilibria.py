"""Drift equilibria of the single-track model on a path of constant curvature, one for each friction."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import root
from torch import Tensor

from pirl_rl.problems.drift.vehicle import accelerations

DEGREE = math.pi / 180
SPEED = 8.0  # m/s, v_x of the equilibria
CURVATURE = 0.600 * math.cos(-20.44 * DEGREE) / SPEED  # 1/m, of the path
FRICTION_BAND = (0.5, 0.6)
KNOTS = 513


def equilibrium(friction: float) -> tuple[np.ndarray, np.ndarray]:
    """State (e_y, e_psi, v_x, v_y, r, delta, mu), (7,), and control (delta', F_x), (2,), to the accuracy of a root.

    v_x = 8 m/s, e_y = 0 and e_psi = -beta are given, so that the car follows the path where r = curvature v_x / cos
    beta; beta, delta and F_x solve v_x' = v_y' = r' = 0.

    Raises:
        ArithmeticError: where the root finder does not converge.
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
        raise ArithmeticError(f"no drift equilibrium found at friction {friction}: residual {found.fun}")
    return point(found.x)


class EquilibriumCurves:
    """beta, r, delta, each (*), of the equilibrium at friction (*), at the band's edge outside it.

    Linear between knots, to 3e-7: the rear tyre slides in all the band, so the curves are smooth.
    """

    def __init__(self):
        # Solved here: a transform of torch.func, in which the curves may first be asked for, lets nothing out to scipy.
        table = torch.from_numpy(_table())
        self._tables: dict[tuple[torch.dtype, torch.device], Tensor] = {(table.dtype, table.device): table}

    def __call__(self, friction: Tensor) -> tuple[Tensor, ...]:
        low, high = FRICTION_BAND
        position = ((friction - low) * ((KNOTS - 1) / (high - low))).clamp(0, KNOTS - 1)
        knot = position.long().clamp(max=KNOTS - 2)
        key = (friction.dtype, friction.device)
        if key not in self._tables:
            self._tables[key] = torch.from_numpy(_table()).to(friction)
        table = self._tables[key]
        return torch.lerp(table[knot], table[knot + 1], (position - knot).unsqueeze(-1)).unbind(-1)


@cache
def _table() -> np.ndarray:
    """beta, r, delta at KNOTS equidistant frictions of the band, (KNOTS, 3).

    A spline through every eighth of them: tenths of a second in place of seconds, for an error of 3e-8.
    """
    knots = np.linspace(*FRICTION_BAND, KNOTS)
    solved = np.stack([equilibrium(friction)[0] for friction in knots[::8]])
    return CubicSpline(knots[::8], solved[:, [1, 4, 5]] * [-1, 1, 1])(knots)
