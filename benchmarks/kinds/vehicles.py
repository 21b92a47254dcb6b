"""Cars, boats and aircraft: headings, obstacles and pursuers."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Steering(ReachAvoidProblem):
    """Drift towards a gate that must be met; noise is correlated, and the gain of the control grows away from 0."""

    horizon = 2.0
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        gain = 2 * (0.3 + x[..., 0].square())
        return rows(torch.full_like(gain, 0.8), gain * u[..., 0] - 0.5 * x[..., 1])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.2, 0.0], [0.25, 0.25])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(0.8 - x[..., 0], x[..., 1].abs() - 0.3)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1 - x[..., 1:].abs()


class Evader(ReachAvoidProblem):
    """Keep away from a pursuer, who is slower; the states are the distance between both."""

    objective = "invariance"
    horizon = 3.0
    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u - 0.7 * x / x.norm(dim=-1, keepdim=True).clamp(min=0.2)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.35, 0.0], [0.0, 0.35])

    def avoid_level(self, x: Tensor) -> Tensor:
        return x.norm(dim=-1) - 0.5


class Slalom(ReachAvoidProblem):
    """Steer a cart of constant speed between two rocks into a disc; the heading is periodic."""

    horizon = 4.0
    states = Box([-2.0, -1.0, -math.pi], [2.0, 1.0, math.pi], periodic=[2])
    controls = Box([-2.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(x[..., 2].cos(), x[..., 2].sin(), u[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.15, 0.0, 0.0], [0.0, 0.15, 0.0], [0.0, 0.0, 0.2])

    def target_level(self, x: Tensor) -> Tensor:
        return (x[..., :2] - x.new_tensor([1.5, 0.0])).norm(dim=-1) - 0.35

    def avoid_level(self, x: Tensor) -> Tensor:
        rocks = x.new_tensor([[-0.5, 0.4], [0.5, -0.4]])
        return (x[..., None, :2] - rocks).norm(dim=-1).amin(-1) - 0.4


class Ring(ReachAvoidProblem):
    """Drive round a ring road, past a block on its inner lane, into a parking lot; radius and periodic angle."""

    horizon = 3.0
    states = Box([0.7, -math.pi], [1.8, math.pi], periodic=[1])
    controls = Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(u[..., 0] - 0.3 * (x[..., 0] - 1.2), u[..., 1] / x[..., 0].clamp(min=0.5))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(rows(torch.full_like(x[..., 0], 0.2), 0.2 / x[..., 0].clamp(min=0.5)))

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(math.cos(0.3) - x[..., 1].cos(), (x[..., 0] - 1.25).abs() - 0.2)

    def avoid_level(self, x: Tensor) -> Tensor:
        block = torch.maximum(math.cos(0.25) - (x[..., 1] - 2).cos(), x[..., 0] - 1.3)
        return torch.minimum(0.45 - (x[..., 0] - 1.25).abs(), block)


class TwoHarbours(ReachAvoidProblem):
    """Sail round a shoal into one of two harbours; the control is the heading, with which the speed changes."""

    horizon = 3.0
    states, controls = Box([-2.0, -1.5], [2.0, 1.5]), Box([-math.pi], [math.pi])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        heading = u[..., 0]
        speed = 0.6 + 0.5 * heading.sin().abs()
        return rows(speed * heading.cos(), speed * heading.sin())

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.3, 0.1], [0.0, 0.25])

    def target_level(self, x: Tensor) -> Tensor:
        narrow = (x - x.new_tensor([1.5, 0.9])).norm(dim=-1) - 0.2
        wide = (x - x.new_tensor([-1.4, -0.8])).norm(dim=-1) - 0.45
        return torch.minimum(narrow, wide)

    def avoid_level(self, x: Tensor) -> Tensor:
        shoal = torch.maximum((x[..., 0] - 0.3).abs() - 0.2, (x[..., 1] - 0.1).abs() - 0.7)
        return torch.minimum(shoal, 1.4 - x[..., 1].abs())


class River(ReachAvoidProblem):
    """Row to a jetty across a river, past an island; the control is the heading."""

    horizon = 4.0
    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-math.pi], [math.pi])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        current = 0.6 * (1 - x[..., 1].square() / 4)
        return rows(0.9 * u[..., 0].cos() + current, 0.9 * u[..., 0].sin())

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.25, 0.0], [0.0, 0.2])

    def target_level(self, x: Tensor) -> Tensor:
        return (x - x.new_tensor([-0.8, 1.5])).norm(dim=-1) - 0.35

    def avoid_level(self, x: Tensor) -> Tensor:
        island = (x - x.new_tensor([-0.3, 0.2])).norm(dim=-1) - 0.45
        return torch.minimum(island, 1.9 - x[..., 1].abs())


class Loiter(ReachAvoidProblem):
    """Stay in the ring about a beacon in a wind that blows outwards; the controls are speed and heading."""

    objective = "invariance"
    horizon = 3.0
    states, controls = Box([-1.6, -1.6], [1.6, 1.6]), Box([0.3, -math.pi], [1.0, math.pi])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        wind = 0.6 * x / x.norm(dim=-1, keepdim=True).clamp(min=0.2) + 0.3 * rows(-x[..., 1], x[..., 0])
        return wind + u[..., :1] * rows(u[..., 1].cos(), u[..., 1].sin())

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.3, 0.0], [0.1, 0.3])

    def avoid_level(self, x: Tensor) -> Tensor:
        radius = x.norm(dim=-1)
        return torch.minimum(radius - 0.4, 1.5 - radius)


class Bicycle(ReachAvoidProblem):
    """Park a car that also drives backwards; a steering angle turns it by as much as its speed allows."""

    horizon = 4.0
    states = Box([-2.0, -2.0, -math.pi], [2.0, 2.0, math.pi], periodic=[2])
    controls = Box([-0.6, -0.6], [1.0, 0.6])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        speed, angle = u.unbind(-1)
        return rows(speed * x[..., 2].cos(), speed * x[..., 2].sin(), speed * angle.tan() / 0.5)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.15])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0].abs() - 0.4, x[..., 1].abs() - 0.3, math.cos(0.5) - x[..., 2].cos())

    def avoid_level(self, x: Tensor) -> Tensor:
        return (x[..., :2] - x.new_tensor([0.9, 0.6])).norm(dim=-1) - 0.35


class TwoCars(ReachAvoidProblem):
    """Keep away from a car that drives straight on; the states are its place and its heading as seen from ours."""

    objective = "invariance"
    horizon = 3.0
    states = Box([-2.5, -2.0, -math.pi], [2.5, 2.0, math.pi], periodic=[2])
    controls = Box([-1.5], [1.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        ahead, aside, heading = x.unbind(-1)
        turn = u[..., 0]
        return rows(-0.8 + heading.cos() + turn * aside, heading.sin() - turn * ahead, -turn)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.2, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.2])

    def avoid_level(self, x: Tensor) -> Tensor:
        return x[..., :2].norm(dim=-1) - 0.5
