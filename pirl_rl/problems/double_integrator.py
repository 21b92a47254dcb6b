"""The double integrator, a mass without friction under a bounded force: bring it to rest near the origin.

It is the textbook example of time-optimal control (M. Athans and P. L. Falb, Optimal Control, McGraw-Hill 1966, Sec.
7.2), here with noise. The state is x = (p, v), position (m) and speed (m/s); the control is the acceleration (m/s^2).
"""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.payoffs import Payoff
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.noise import independent_noise
from pirl_rl.sets import Box, Plane


class DoubleIntegrator(ReachAvoidProblem):
    """dp = v dt + noise, dv = u dt + noise, |u| <= 1: come to rest at p = 0 in T = 3 s, with |p|, |v| < 1 until then.

    The target is the box |p| <= 0.2, |v| <= 0.2.

    Args:
        payoff: replaces the indicator of the target.
        horizon: replaces the horizon, in s.
        position_noise: the strength of the noise on the position, in m per sqrt(s); at 0 there is noise on the speed
            alone.
        speed_noise: the strength of the noise on the speed, in m/s per sqrt(s).
    """

    horizon = 3.0
    states = Box([-1.0, -1.0], [1.0, 1.0])
    controls = Box([-1.0], [1.0])
    state_names = ("p (m)", "v (m/s)")
    control_names = ("u (m/s^2)",)
    tolerance = 0.2  # m and m/s, half of the target's widths
    limit = 1.0  # m and m/s, of |p| and |v|

    def __init__(
        self,
        payoff: Payoff | None = None,
        horizon: float | None = None,
        position_noise: float = 0.2,
        speed_noise: float = 0.4,
    ):
        super().__init__(payoff, horizon)
        self.noise = (float(position_noise), float(speed_noise))

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([x[..., 1:], u], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return independent_noise(x, self.noise)

    def target_constraints(self, x: Tensor) -> Tensor:
        return x.abs() - self.tolerance

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return self.limit - x.abs()

    @property
    def planes(self) -> dict[str, Plane]:
        """The whole state space."""
        axes = ("position p (m)", "speed v (m/s)")
        return {"p_v": Plane(axes, self.states, lambda points: points, lambda x: x)}
