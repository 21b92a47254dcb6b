"""The Dubins car: a vehicle of constant speed and bounded turn rate reaches a disc around a rock and between walls.

The vehicle is that of L. E. Dubins (American Journal of Mathematics 79, 1957), with noise. The state is x = (x_1, x_2,
theta): the position (m) and the heading (rad), which has the period 2 pi; the control is the turn rate (rad/s).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pirl_rl.constants import constant
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.noise import independent_noise
from pirl_rl.sets import Box, Plane


class DubinsCar(ReachAvoidProblem):
    """Drive at 1 m/s with a turn rate of at most 1.5 rad/s into a disc within T = 4 s, past a rock and inside walls."""

    horizon = 4.0
    states = Box([-2.0, -2.0, -math.pi], [2.0, 2.0, math.pi], periodic=[2])
    controls = Box([-1.5], [1.5])
    state_names = ("x_1 (m)", "x_2 (m)", "theta (rad)")
    control_names = ("u (rad/s)",)
    speed = 1.0  # m/s
    noise = (0.1, 0.1, 0.3)  # m, m and rad per sqrt(s)
    target, target_radius = (1.2, 0.0), 0.3  # m
    rock, rock_radius = (0.1, 0.0), 0.4  # m
    wall = 2.0  # m, of |x_1| and |x_2|

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        theta = x[..., 2]
        return torch.stack([self.speed * theta.cos(), self.speed * theta.sin(), u[..., 0]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return independent_noise(x, self.noise)

    def target_level(self, x: Tensor) -> Tensor:
        return (x[..., :2] - constant(self.target, x)).norm(dim=-1) - self.target_radius

    def avoid_constraints(self, x: Tensor) -> Tensor:
        rock = (x[..., :2] - constant(self.rock, x)).norm(dim=-1, keepdim=True) - self.rock_radius
        return torch.cat([rock, self.wall - x[..., :2].abs()], -1)

    @property
    def planes(self) -> dict[str, Plane]:
        """Positions with the heading theta = 0, towards the target from the left."""
        position = Plane(
            ("x_1 (m)", "x_2 (m)"),
            Box(self.states.low[:2], self.states.high[:2]),
            lambda points: torch.cat([points, torch.zeros_like(points[..., :1])], -1),
            lambda x: x[..., :2],
        )
        return {"position": position}
