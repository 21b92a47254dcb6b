"""Vehicle drifting in three states, few enough for a grid (Hindiyeh and Gerdes, J. Dyn. Sys. Meas. Control 136, 2014).

The state is x = (beta, r, v_x): the sideslip angle (rad), the yaw rate (rad/s) and the longitudinal velocity (m/s). The
control is u = (delta, F_x): the steering angle (rad) and the drive force (N).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.optimize import root
from torch import Tensor

from pirl_rl.constants import constant
from pirl_rl.payoffs import Payoff
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.drift import vehicle
from pirl_rl.problems.drift.equilibria import DEGREE, SPEED
from pirl_rl.problems.drift.problem import VehicleDrift
from pirl_rl.sets import Box, Plane

STEERING = -12 * DEGREE  # rad, delta of the equilibrium in the article


class VehicleDrift3(ReachAvoidProblem):
    """Reach the drift equilibrium within T = 5 s, before the car spins, stops or runs away.

    Args:
        payoff: replaces the indicator of the target.
        horizon: replaces the horizon, in s.
        friction: the friction coefficient of both axles.

    Attributes:
        equilibrium: the state (3,) in the middle of the target, and its control (2,).

    Raises:
        ArithmeticError: no equilibrium is found at this friction.
    """

    horizon = 5.0
    states = Box([-math.pi / 4, -2.5, 4.0], [math.pi / 4, 2.5, 12.0])
    controls = Box([-0.7, 1000.0], [0.7, 5000.0])
    state_names = ("beta (rad)", "r (rad/s)", "v_x (m/s)")
    control_names = ("delta (rad)", "F_x (N)")
    tolerances = {name: VehicleDrift.tolerances[name] for name in ("beta", "r", "v_x")}
    # In units of the state per sqrt(s). Noise of 0.20 m/s in v_y is noise of 0.20 cos(beta)^2 / v_x in
    # beta = atan2(v_y, v_x). It is taken at beta = 0 and at v_x of the equilibrium, so that sigma is constant.
    noise = (VehicleDrift.noise[3] / SPEED, VehicleDrift.noise[4], VehicleDrift.noise[2])

    def __init__(self, payoff: Payoff | None = None, horizon: float | None = None, friction: float = 0.55):
        super().__init__(payoff, horizon)
        self.friction = float(friction)
        self.equilibrium = equilibrium(self)
        self._middle = tuple(self.equilibrium[0].tolist())

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        """f (*, 3), in units of the state per s. As in the article, F_yf enters v_y' and r' without cos(delta)."""
        beta, r, v_x = x.unbind(-1)
        delta, demand = u.unbind(-1)
        v_x, tan_beta = v_x.clamp(min=vehicle.LEAST_SPEED), beta.tan()
        v_y, friction = v_x * tan_beta, torch.full_like(v_x, self.friction)
        drive = vehicle.drive_force(demand, friction)
        front = vehicle.front_force(v_x, v_y, r, delta.tan(), friction)
        rear = vehicle.rear_force(v_x, v_y, r, friction, drive)
        along = (drive - front * delta.sin()) / vehicle.MASS + v_y * r
        across = (rear + front) / vehicle.MASS - v_x * r
        rates = [
            (across - tan_beta * along) * beta.cos() ** 2 / v_x,  # beta' with beta = atan2(v_y, v_x)
            (vehicle.FRONT_ARM * front - vehicle.REAR_ARM * rear) / vehicle.YAW_INERTIA,
            along,
        ]
        return torch.stack(rates).movedim(0, -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        columns = constant(self.noise, x).diag()
        return columns.expand(*x.shape, 3)

    def target_constraints(self, x: Tensor) -> Tensor:
        return (x - constant(self._middle, x)).abs() - constant([*self.tolerances.values()], x)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        beta, r, v_x = x.unbind(-1)
        slow, fast = VehicleDrift.speeds
        bounds = [math.pi / 4 - beta.abs(), VehicleDrift.limits["r"] - r.abs(), v_x - slow, fast - v_x]
        return torch.stack(bounds).movedim(0, -1)

    @property
    def planes(self) -> dict[str, Plane]:
        """The beta-r section at v_x of the equilibrium."""
        beta_r = Plane(
            ("sideslip beta (rad)", "yaw rate r (rad/s)"),
            Box(self.states.low[:2], self.states.high[:2]),
            lambda points: torch.cat([points, torch.full_like(points[..., :1], SPEED)], -1),
            lambda x: x[..., :2],
        )
        return {"beta_r": beta_r}


def equilibrium(problem: VehicleDrift3) -> tuple[np.ndarray, np.ndarray]:
    """The state (3,) and control (2,), in SI units, of the drift equilibrium at v_x = 8 m/s and delta = -12 degrees.

    Raises:
        ArithmeticError: the root finder does not converge, or the control is not admissible.
    """

    def point(unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        beta, r, force = unknown
        return np.array([beta, r, SPEED]), np.array([STEERING, 1000 * force])

    def residual(unknown: np.ndarray) -> np.ndarray:
        x, u = (torch.from_numpy(entry) for entry in point(unknown))
        return problem.drift(x, u).numpy()

    found = root(residual, [-20.44 * DEGREE, 0.600, 2.293], method="hybr", tol=1e-14)
    x, u = point(found.x)
    if np.abs(found.fun).max() > 1e-9 or not problem.controls.contains(torch.from_numpy(u)):
        raise ArithmeticError(
            f"no drift equilibrium found at friction {problem.friction}: expected residuals <= 1e-9 and an admissible "
            f"control, got {found.fun} and {u}"
        )
    return x, u
