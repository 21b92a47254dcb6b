"""Cart and pole as an invariance problem: keep a pole upright on a cart between two stops.

Equations, constants and limits are those of A. G. Barto, R. S. Sutton and C. W. Anderson (IEEE Transactions on Systems,
Man, and Cybernetics 13, 1983), whose force of 10 N in either direction is the bound of the force here. The state is
x = (p, v, theta, omega): position (m) and speed (m/s) of the cart, angle of the pole from upright (rad) and its rate
(rad/s); the control is the force on the cart (N).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pirl_rl.constants import constant
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.noise import independent_noise
from pirl_rl.sets import Box, Plane


class CartPole(ReachAvoidProblem):
    """Keep |p| < 2.4 m and |theta| < 12 degrees for T = 2 s by a force of at most 10 N, in gusts on cart and pole."""

    objective = "invariance"
    horizon = 2.0
    states = Box([-2.4, -4.0, -math.pi / 15, -3.0], [2.4, 4.0, math.pi / 15, 3.0])
    controls = Box([-10.0], [10.0])
    state_names = ("p (m)", "v (m/s)", "theta (rad)", "omega (rad/s)")
    control_names = ("F (N)",)
    gravity = 9.8  # m/s^2
    cart_mass = 1.0  # kg
    pole_mass = 0.1  # kg
    half_length = 0.5  # m, half of the pole's length
    cart_friction = 0.0005  # of the cart on the track, N
    pole_friction = 0.000002  # of the pole on the cart, kg m^2/s
    noise = (0.0, 1.0, 0.0, 1.0)  # of p, v, theta and omega, in their units per sqrt(s)
    limits = (2.4, math.pi / 15)  # m and rad, of |p| and |theta|

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        _, v, theta, omega = x.unbind(-1)
        sin, cos = theta.sin(), theta.cos()
        mass, moment = self.cart_mass + self.pole_mass, self.pole_mass * self.half_length
        # The sign of v in the article's friction is smoothed over 1 cm/s, so that the drift is continuous.
        pushed = u[..., 0] + moment * omega**2 * sin - self.cart_friction * torch.tanh(100 * v)
        turned = self.gravity * sin - cos * pushed / mass - self.pole_friction * omega / moment
        angular = turned / (self.half_length * (4 / 3 - self.pole_mass * cos**2 / mass))
        return torch.stack([v, (pushed - moment * angular * cos) / mass, omega, angular], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return independent_noise(x, self.noise)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return constant(self.limits, x) - x[..., ::2].abs()

    @property
    def planes(self) -> dict[str, Plane]:
        """The pole with the cart at rest in the middle, and the cart with the pole at rest upright."""
        return {
            "pole": self._plane((2, 3), ("angle theta (rad)", "rate omega (rad/s)")),
            "cart": self._plane((0, 1), ("position p (m)", "speed v (m/s)")),
        }

    def _plane(self, axes: tuple[int, int], names: tuple[str, str]) -> Plane:
        first = axes[0]
        box = Box([self.states.low[axis] for axis in axes], [self.states.high[axis] for axis in axes])
        return Plane(
            names,
            box,
            lambda points: torch.nn.functional.pad(points, (first, 2 - first)),
            lambda x: x[..., first : first + 2],
        )
