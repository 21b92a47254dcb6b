"""A mass in two wells, a car in a valley, a pendulum, a person on a shaking platform, a mirror: forces are weak."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Duffing(ReachAvoidProblem):
    """Bring a mass from anywhere to rest in the right one of two wells, never faster than 1.2 m/s.

    The barrier takes 0.385 N, and there are 0.2 N.
    """

    horizon = 6.0
    states, controls = Box([-1.7, -1.2], [1.7, 1.2]), Box([-0.2], [0.2])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        p, v = x.unbind(-1)
        return rows(v, p - p**3 - 0.3 * v + u[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.25])

    def target_constraints(self, x: Tensor) -> Tensor:
        p, v = x.unbind(-1)
        return rows(0.7 - p, p - 1.3, v - 0.4, -0.4 - v)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(1.2 - x[..., 1], 1.2 + x[..., 1])


class MountainCar(ReachAvoidProblem):
    """The mountain car of A. W. Moore (thesis, Cambridge, 1990) in continuous time, with gusts and a wall behind."""

    horizon = 6.0
    states, controls = Box([-1.2, -1.4], [0.45, 1.4]), Box([-0.35], [0.35])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(x[..., 1], u[..., 0] - torch.cos(3 * x[..., 0]))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.25])

    def target_constraints(self, x: Tensor) -> Tensor:
        return 0.45 - x[..., :1]

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., :1] + 1.2


class Swingup(ReachAvoidProblem):
    """Swing a pendulum (1 kg, 1 m) up with 5 N m, about half of what holds it level; the angle 0 is upright."""

    horizon = 4.0
    states = Box([-math.pi, -8.0], [math.pi, 8.0], periodic=[0])
    controls = Box([-5.0], [5.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        angle, speed = x.unbind(-1)
        return rows(speed, 9.81 * torch.sin(angle) + u[..., 0] - 0.1 * speed)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [1.0])

    def target_constraints(self, x: Tensor) -> Tensor:
        angle, speed = x.unbind(-1)
        return rows(math.cos(0.3) - torch.cos(angle), speed - 1, -1 - speed)


class QuietStance(ReachAvoidProblem):
    """A person on a shaking platform must not fall for 6 s: lean in degrees, rate in deg/s, torque of the ankle in N m.

    The torque is weaker at the heel than at the toes, and its noise grows with its size.
    """

    objective = "invariance"
    horizon = 6.0
    states, controls = Box([-5.0, -20.0], [9.0, 20.0]), Box([-45.0], [100.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        lean, rate = x.unbind(-1)
        torque = 687.0 * torch.deg2rad(lean).sin() - u[..., 0]
        return rows(rate, torch.rad2deg(torque / 92.0))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        jerk = torch.rad2deg((9.0 + 0.1 * u.abs()) / 92.0)
        return torch.stack([torch.zeros_like(jerk), jerk], -2)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        lean, rate = x.unbind(-1)
        return rows(lean + 5.0, 9.0 - lean, 20.0 - rate.abs())


class LongWatch(ReachAvoidProblem):
    """A mirror on a spring has to keep its angle and its rate small for eighty of its periods, against gusts.

    A control matters within a period and hardly changes V, but what it changes adds up over the horizon.
    """

    objective = "invariance"
    horizon = 500.0
    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-0.3], [0.3])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        angle, rate = x.unbind(-1)
        return rows(rate, u[..., 0] - angle - 0.4 * rate)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.6])

    def avoid_level(self, x: Tensor) -> Tensor:
        return 2.0 - x.abs().amax(-1)
