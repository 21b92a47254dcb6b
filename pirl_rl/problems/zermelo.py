"""Zermelo's boat: reach a landing across a river whose current is faster than the boat.

The navigation problem is that of E. Zermelo (Zeitschrift fuer Angewandte Mathematik und Mechanik 11, 1931). With noise,
as a reach-avoid problem, it is an example of P. Mohajerin Esfahani, D. Chatterjee and J. Lygeros (Automatica 70, 2016).
The state is x = (x_1, x_2), along and across the river (m); the control is the velocity through the water (m/s).
"""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.constants import constant
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.noise import independent_noise
from pirl_rl.sets import Box, Plane


class ZermeloBoat(ReachAvoidProblem):
    """dx = (c(x_2) + u_1, u_2) dt + 0.3 dW, c = 1 - x_2^2: reach the landing before rock, banks and ends, T = 4 s.

    The boat makes at most 0.8 m/s along each axis, less than the current in the middle of the river.
    """

    horizon = 4.0
    states = Box([-2.0, -1.0], [2.0, 1.0])
    controls = Box([-0.8, -0.8], [0.8, 0.8])
    state_names = ("x_1 (m)", "x_2 (m)")
    control_names = ("u_1 (m/s)", "u_2 (m/s)")
    current = 1.0  # m/s, in the middle of the river; at the banks, x_2 = -1 m and 1 m, it is 0
    noise = (0.3, 0.3)  # m per sqrt(s)
    landing, landing_radius = (1.4, 0.4), 0.3  # m
    rock, rock_radius = (0.0, 0.2), 0.35  # m
    limits = (2.0, 1.0)  # m, of |x_1| and |x_2|

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        stream = self.current * (1 - (x[..., 1] / self.limits[1]) ** 2)
        return torch.stack([stream + u[..., 0], u[..., 1]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return independent_noise(x, self.noise)

    def target_level(self, x: Tensor) -> Tensor:
        return (x - constant(self.landing, x)).norm(dim=-1) - self.landing_radius

    def avoid_constraints(self, x: Tensor) -> Tensor:
        rock = (x - constant(self.rock, x)).norm(dim=-1, keepdim=True) - self.rock_radius
        return torch.cat([rock, constant(self.limits, x) - x.abs()], -1)

    @property
    def planes(self) -> dict[str, Plane]:
        """The river."""
        axes = ("along the river x_1 (m)", "across the river x_2 (m)")
        return {"river": Plane(axes, self.states, lambda points: points, lambda x: x)}
