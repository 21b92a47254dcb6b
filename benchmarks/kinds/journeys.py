"""A solar car, a balancing scooter and a barge, whose journeys need strength, balance or foresight."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class SolarCar(ReachAvoidProblem):
    """Drive 250 km in four hours before the battery is empty, under clouds that come and go.

    The states are the way in 100 km, the charge in kWh and the power of the sun in kW, the control is the speed in
    100 km/h. The motor needs power in proportion to the cube of the speed.
    """

    horizon = 4.0
    states, controls = Box([0.0, 0.0, 0.0], [2.6, 5.0, 1.6]), Box([0.0], [1.2])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        speed, sun = u[..., 0], x[..., 2]
        return rows(speed, sun - 3 * speed**3, 1.5 * (0.8 - sun))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0, 0.0], [0.3, 0.0], [0.0, 0.7])

    def target_constraints(self, x: Tensor) -> Tensor:
        return 2.5 - x[..., :1]

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., 1:2]


class Scooter(ReachAvoidProblem):
    """Stay upright on a balancing scooter for 4 s, never faster than 2 m/s; lean, its rate and speed, in rad, m and s.

    The control is the acceleration of the wheels. Noise acts on the rate alone, and beyond 2.5 rad/s the motor stops.
    """

    objective = "invariance"
    horizon = 4.0
    states, controls = Box([-0.5, -2.5, -2.0], [0.5, 2.5, 2.0]), Box([-6.0], [6.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        lean, rate, push = x[..., 0], x[..., 1], u[..., 0]
        return rows(rate, 9.8 * lean.sin() - push * lean.cos(), push)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [1.0], [0.0])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1 - (x / x.new_tensor([0.5, 2.5, 2.0])).abs()


class Barge(ReachAvoidProblem):
    """Push a barge round a bend of a river to a pier within 40 min, past two shallows; km and min, little noise."""

    horizon = 40.0
    states, controls = Box([-2.0, -1.0], [2.0, 1.0]), Box([-0.08, -0.08], [0.08, 0.08])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        along, across = x.unbind(-1)
        current = 0.06 * (1 - across**2)
        return rows(u[..., 0] + current, u[..., 1] - 0.3 * current * along)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.015, 0.0], [0.0, 0.015])

    def target_constraints(self, x: Tensor) -> Tensor:
        return (x - x.new_tensor([1.2, 0.7])).abs() - 0.15

    def avoid_constraints(self, x: Tensor) -> Tensor:
        shallows = x.new_tensor([[0.3, 0.35], [0.7, -0.4]])
        stranded = (x.unsqueeze(-2) - shallows).norm(dim=-1) - x.new_tensor([0.3, 0.25])
        return torch.cat([stranded, 1 - x[..., 1:].abs()], -1)
