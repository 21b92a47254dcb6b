"""The planar quadrotor: come to hover in a small box in the middle of a room before ground, ceiling or walls.

Equations and constants are those of the planar quadrotor of R. Tedrake, Underactuated Robotics (course notes, MIT),
Chap. 3, and of the example Quadrotor2D of Drake. The state is x = (x, z, theta, x', z', theta'): position (m), angle
from level (rad), and their rates (m/s, rad/s); the control is the thrust of the two rotors (N).
"""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.constants import constant
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.noise import independent_noise
from pirl_rl.sets import Box, Plane


class PlanarQuadrotor(ReachAvoidProblem):
    """Hover at x = 0, z = 1 m within T = 2 s, at |x| < 2 m, 0 < z < 2 m and |theta| < 1.2 rad, against gusts.

    The target, a box in all six coordinates, fills less than one ten-thousandth of the box of states.
    """

    horizon = 2.0
    gravity = 9.81  # m/s^2
    mass = 0.486  # kg
    arm = 0.25  # m, from the centre to a rotor
    inertia = 0.00383  # kg m^2
    states = Box([-2.0, 0.0, -1.0, -2.0, -2.0, -5.0], [2.0, 2.0, 1.0, 2.0, 2.0, 5.0])
    controls = Box([0.0, 0.0], [mass * gravity, mass * gravity])  # each rotor lifts at most the weight
    state_names = ("x (m)", "z (m)", "theta (rad)", "x' (m/s)", "z' (m/s)", "theta' (rad/s)")
    control_names = ("u_1 (N)", "u_2 (N)")
    hover = (0.0, 1.0, 0.0, 0.0, 0.0, 0.0)  # the middle of the target
    tolerances = (0.3, 0.3, 0.2, 0.5, 0.5, 1.5)  # half of the target's widths
    limits = (2.0, 1.0, 1.2)  # m, m and rad, of |x|, |z - 1| and |theta|; B is beyond
    noise = (0.0, 0.0, 0.0, 0.5, 0.5, 1.0)  # of the states, in their units per sqrt(s)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        theta, lift, turn = x[..., 2], u.sum(-1), u[..., 0] - u[..., 1]
        rates = [
            -lift * theta.sin() / self.mass,
            lift * theta.cos() / self.mass - self.gravity,
            self.arm * turn / self.inertia,
        ]
        return torch.cat([x[..., 3:], torch.stack(rates, -1)], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return independent_noise(x, self.noise)

    def target_constraints(self, x: Tensor) -> Tensor:
        return (x - constant(self.hover, x)).abs() - constant(self.tolerances, x)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return constant(self.limits, x) - (x - constant(self.hover, x))[..., :3].abs()

    @property
    def planes(self) -> dict[str, Plane]:
        """The room, with the quadrotor level and at rest, and the angle and its rate in the middle of the room."""
        return {
            "room": self._plane((0, 1), ("x (m)", "z (m)")),
            "attitude": self._plane((2, 5), ("angle theta (rad)", "rate theta' (rad/s)")),
        }

    def _plane(self, axes: tuple[int, int], names: tuple[str, str]) -> Plane:
        box = Box([self.states.low[axis] for axis in axes], [self.states.high[axis] for axis in axes])

        def embed(points: Tensor) -> Tensor:
            x = points.new_tensor(self.hover).expand(*points.shape[:-1], 6).clone()
            x[..., axes] = points
            return x

        return Plane(names, box, embed, lambda x: x[..., axes])
