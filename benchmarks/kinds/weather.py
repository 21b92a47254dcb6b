"""A storm, a tide, and a wind that grows with height: ways that lead through weather."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem


class Storm(ReachAvoidProblem):
    """Stay in a square for 2 s in a storm that grows to the east and leaves little chance."""

    objective = "invariance"
    horizon = 2.0
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 2 * u + 0.5 * x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [1.6, 0.0], [0.8, 1.4]) * (1 + 0.3 * x[..., :1, None])

    def avoid_level(self, x: Tensor) -> Tensor:
        return 0.95 - x.abs().amax(-1)


class Tide(ReachAvoidProblem):
    """Cross a channel around a rock, in a current that turns with the tide, whose phase is a state; in km and h."""

    horizon = 3.0
    states = Box([-1.5, -1.0, 0.0], [1.5, 1.0, 2 * math.pi], periodic=[2])
    controls = Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        along, across, phase = x.unbind(-1)
        current = 1.2 * torch.cos(phase) * (1 - across.square())
        return rows(0.6 * u[..., 0] + current, 0.6 * u[..., 1], torch.full_like(along, 1.5))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.2, 0.0], [0.0, 0.12], [0.0, 0.0])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows((x[..., 0] - 0.5).abs() - 0.3, 0.75 - x[..., 1])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        from_rock = torch.hypot(x[..., 0] + 0.2, x[..., 1] - 0.1)
        return rows(1.45 - x[..., 0].abs(), x[..., 1] + 0.98, from_rock - 0.25)


class Drone3(ReachAvoidProblem):
    """Fly between two pillars into a window, in a wind that grows with height; three speeds are the controls; m, s."""

    horizon = 3.0
    states = Box([0.0, -1.0, 0.0], [3.0, 1.0, 1.5])
    controls = Box([-0.2, -0.8, -0.5], [1.2, 0.8, 0.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(u[..., 0], u[..., 1] + 0.3 * x[..., 2], u[..., 2])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.15, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 0.15])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(2.7 - x[..., 0], (x[..., 1] + 0.3).abs() - 0.35, (x[..., 2] - 0.8).abs() - 0.35)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        a, b, height = x.unbind(-1)
        left, right = torch.hypot(a - 1.2, b - 0.25) - 0.3, torch.hypot(a - 1.9, b + 0.6) - 0.25
        return rows(left, right, 0.97 - b.abs(), height - 0.05, 1.45 - height)
