"""The inverted pendulum as an invariance problem: keep a rod upright with a torque that is too weak to lift it.

The equation of motion and its constants are those of Pendulum-v1 of Gymnasium: a uniform rod that turns about its end.
The state is x = (theta, omega), the angle from upright (rad) and its rate (rad/s); the control is the torque (N m).
"""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.constants import constant
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.noise import independent_noise
from pirl_rl.sets import Box, Plane


class Pendulum(ReachAvoidProblem):
    """Keep |theta| < 0.6 rad and |omega| < 2.5 rad/s for T = 2 s with a torque of at most 2 N m and a noisy torque.

    The torque balances the rod up to |theta| = 0.41 rad. Beyond that the rod falls, unless it turns back already.
    """

    objective = "invariance"
    horizon = 2.0
    states = Box([-0.6, -2.5], [0.6, 2.5])
    controls = Box([-2.0], [2.0])
    state_names = ("theta (rad)", "omega (rad/s)")
    control_names = ("u (N m)",)
    gravity = 10.0  # m/s^2
    mass = 1.0  # kg
    length = 1.0  # m
    limits = (0.6, 2.5)  # rad and rad/s, of |theta| and |omega|
    noise = (0.0, 0.6)  # of the angle and of its rate, in rad and rad/s per sqrt(s)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        theta, omega = x.unbind(-1)
        acceleration = 3 * self.gravity / (2 * self.length) * theta.sin() + 3 / (self.mass * self.length**2) * u[..., 0]
        return torch.stack([omega, acceleration], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return independent_noise(x, self.noise)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return constant(self.limits, x) - x.abs()

    @property
    def planes(self) -> dict[str, Plane]:
        """The whole state space."""
        axes = ("angle theta (rad)", "rate omega (rad/s)")
        return {"theta_omega": Plane(axes, self.states, lambda points: points, lambda x: x)}
