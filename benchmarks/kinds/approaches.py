"""A pursuer, a unicycle, a spacecraft, two chains of integrators and a drifting vessel: to meet a small set."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Pursuit(ReachAvoidProblem):
    """Catch an evader in a current before it crosses a border; the closer its pursuer, the more it staggers."""

    horizon = 4.0
    states, controls = Box([-3.0, -3.0], [3.0, 3.0]), Box([-0.8, -0.8], [0.8, 0.8])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([0.6, 0.2]) - u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        strength = 0.3 + 0.5 * torch.exp(-x.square().sum(-1, keepdim=True) / 2)
        return torch.diag_embed(strength.expand_as(x))

    def target_level(self, x: Tensor) -> Tensor:
        return x.square().sum(-1) - 0.25

    def avoid_level(self, x: Tensor) -> Tensor:
        return 3 - x[..., 0]


class Unicycle(ReachAvoidProblem):
    """Drive a unicycle with a speed of its own into a disc, between or round two discs."""

    horizon = 5.0
    states = Box([-3.0, -3.0, -math.pi, 0.0], [3.0, 3.0, math.pi, 2.0], periodic=[2])
    controls = Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        heading, speed = x[..., 2], x[..., 3]
        return rows(speed * heading.cos(), speed * heading.sin(), u[..., 0], u[..., 1] - 0.5 * speed)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(x.new_tensor([0.15, 0.15, 0.3, 0.2]).expand_as(x))

    def target_level(self, x: Tensor) -> Tensor:
        return (x[..., :2] - x.new_tensor([2.0, 0.0])).square().sum(-1) - 0.25

    def avoid_constraints(self, x: Tensor) -> Tensor:
        discs = x.new_tensor([[0.0, 0.6], [0.0, -1.2]])
        return (x[..., None, :2] - discs).square().sum(-1) - 0.49


class Chain(ReachAvoidProblem):
    """Four integrators with noise in all of them: into a small box at the origin, and never out of a large one."""

    horizon = 6.0
    states, controls = Box([-4.0, -2.0, -2.0, -2.0], [4.0, 2.0, 2.0, 2.0]), Box([-4.0], [4.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([x[..., 1:], u], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(torch.full_like(x, 0.2))

    def target_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([x - 0.6, -0.6 - x], -1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        edge = x.new_tensor([4.0, 2.0, 2.0, 2.0])
        return torch.cat([edge - x, edge + x], -1)


class Rendezvous(ReachAvoidProblem):
    """Bring a spacecraft to its port slowly within 100 s, in the cone that the sensors see.

    The motion is that of Clohessy and Wiltshire in the plane of the orbit; problem after K. Lesser, M. Oishi and
    R. S. Erwin (CDC 2013).
    """

    horizon = 100.0
    states = Box([-20.0, -40.0, -0.5, -0.5], [20.0, 0.0, 0.5, 0.5])
    controls = Box([-0.02, -0.02], [0.02, 0.02])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        (px, _, vx, vy), rate = x.unbind(-1), 0.00113
        return rows(vx, vy, 3 * rate**2 * px + 2 * rate * vy + u[..., 0], u[..., 1] - 2 * rate * vx)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0, 0.0], [0.0, 0.0], [0.05, 0.0], [0.0, 0.05])

    def target_constraints(self, x: Tensor) -> Tensor:
        px, py, vx, vy = x.unbind(-1)
        near, slow = rows(px - 1, -1 - px, py + 1, -3 - py), rows(vx - 0.2, -0.2 - vx, vy - 0.2, -0.2 - vy)
        return torch.cat([near, slow], -1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(-x[..., 1] - x[..., 0], x[..., 0] - x[..., 1])


class Gantry(ReachAvoidProblem):
    """Bring a trolley to rest between two walls by its jerk; noise in the acceleration alone."""

    horizon = 2.0
    states, controls = Box([-1.0, -1.5, -2.0], [1.0, 1.5, 2.0]), Box([-5.0], [5.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([x[..., 1:], u], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.0], [1.5])

    def target_constraints(self, x: Tensor) -> Tensor:
        return x.abs() - x.new_tensor([0.2, 0.3, 0.8])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(1 - x[..., 0].abs(), 1.5 - x[..., 1].abs())


class Interceptor(ReachAvoidProblem):
    """Meet a vessel that drifts at random, past a reef, with the heading as control; relative position in km, and h."""

    horizon = 4.0
    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-math.pi], [math.pi])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        heading = u[..., 0]
        return rows(0.7 * torch.cos(heading) - 0.3, 0.7 * torch.sin(heading) + 0.2 * x[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.2, 0.0], [0.0, 0.3])

    def target_level(self, x: Tensor) -> Tensor:
        return torch.hypot(x[..., 0] - 0.9, x[..., 1] - 0.6) - 0.25

    def avoid_constraints(self, x: Tensor) -> Tensor:
        reef = torch.maximum((x[..., 0] - 0.2).abs(), (x[..., 1] - 0.3).abs() / 3) - 0.2
        return rows(reef, 1.9 - x.abs().amax(-1))
