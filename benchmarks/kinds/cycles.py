"""A reactor, a generator, a body clock, a searchlight and two flywheels: drifts that jump, and periodic states."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Runaway(ReachAvoidProblem):
    """Bring a reactor to a thin band of temperatures, before it dies out or runs away, by a coolant; in K and s."""

    horizon = 400.0
    states, controls = Box([320.0], [400.0]), Box([0.0], [40.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        heat = 0.17 * torch.exp(9_000 * (1 / 365 - 1 / x.clamp(min=250)))  # Arrhenius, K/s
        cooling = 0.012 * (0.15 + u / (u + 8)) * (x - 320)
        valve = 0.25 * (x > 385).to(x)  # the relief valve opens: a jump
        return heat - cooling - valve

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.35 + 0.008 * (x - 320).abs() + 0.015 * u).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return (x - 362).abs() - 1.5

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([395 - x, x - 328], -1)


class JetLag(ReachAvoidProblem):
    """Shift a body clock to the new day by light, which helps or harms with the phase; in hours, over four days."""

    horizon = 4.0
    states, controls = Box([-12.0], [12.0], periodic=[0]), Box([0.0], [3.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        response = 6 * torch.cos(2 * math.pi * (x + 9) / 24)
        return 0.8 + u / (1 + u) * response

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.6 + 0.25 * u).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return math.cos(2 * math.pi / 24) - torch.cos(2 * math.pi * x[..., 0] / 24)

    def avoid_level(self, x: Tensor) -> Tensor:
        return math.cos(2 * math.pi * 0.8 / 24) - torch.cos(2 * math.pi * (x[..., 0] - 10.5) / 24)


class Searchlight(ReachAvoidProblem):
    """Slip into one of two shelters past a beam that sweeps by again and again; the second state is its clock."""

    horizon = 2.5
    states, controls = Box([-1.5, 0.0], [1.5, 3.0], periodic=[1]), Box([-0.9], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(u[..., 0] - 0.2 * torch.sin(3 * x[..., 0]), torch.ones_like(x[..., 0]))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.4], [0.0]]).expand(*x.shape, 1)

    def target_level(self, x: Tensor) -> Tensor:
        return torch.maximum(torch.minimum(1.2 - x[..., 0], x[..., 0] + 1.3), -self.avoid_level(x))

    def avoid_level(self, x: Tensor) -> Tensor:
        beam = -2 + 4 * x[..., 1] / 3  # runs from -2 to 2 in a period, and then comes back at -2
        return torch.remainder(x[..., 0] - beam + 2, 4).sub(2).abs() - 0.2


class PowerSwing(ReachAvoidProblem):
    """Catch the rotor of a generator before it slips a pole, by a voltage that multiplies the sine of its angle."""

    horizon = 1.5
    states, controls = Box([-0.6, -6.0], [2.8, 8.0]), Box([0.8], [1.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        angle, speed = x.unbind(-1)
        return rows(speed, (0.8 - u[..., 0] * angle.sin() - 0.02 * speed) / 0.05)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        strength = 0.8 + 1.2 * x[..., 0].sin().abs()
        return rows(torch.zeros_like(strength), strength).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        angle, speed = x.unbind(-1)
        rest = 0.7297  # sin = 0.8/1.2
        energy = 0.025 * speed.square() - 0.8 * (angle - rest) - 1.2 * (angle.cos() - math.cos(rest))
        return rows(energy - 0.02, angle - 1.6)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(2.6 - x[..., 0], x[..., 0] + 0.5)


class Flywheels(ReachAvoidProblem):
    """Bring two flywheels, which pull each other, to the same mark within 12 s, never in opposite phase; in rad and s.

    The phases are those of Y. Kuramoto's oscillators, and the control turns the first one.
    """

    horizon = 12.0
    states = Box([-math.pi, -math.pi], [math.pi, math.pi], periodic=[0, 1])
    controls = Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        first, second = x.unbind(-1)
        pull = 0.4 * (second - first).sin()
        return rows(0.2 + pull + u[..., 0], 0.5 - pull)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.3, 0.0], [0.0, 0.4])

    def target_level(self, x: Tensor) -> Tensor:
        return 0.93 - x.cos().amin(-1)

    def avoid_level(self, x: Tensor) -> Tensor:
        return 0.9 + (x[..., 0] - x[..., 1]).cos()
