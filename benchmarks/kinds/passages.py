"""A satellite, an arm, boats, a glider and two doors: obstacles are passed on either side, or against time."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.kinds.shapes import constant, rows
from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.problems import ZermeloBoat


class SlotChange(ReachAvoidProblem):
    """Move a geostationary satellite to one of two free slots past four others, which it must not go by slowly.

    The states are the longitude in degrees (periodic) and its drift in degrees per day. The quicker the drift, the
    farther is the orbit from theirs.
    """

    horizon = 32.0
    states, controls = Box([-180.0, -5.0], [180.0, 5.0], periodic=[0]), Box([-0.35], [0.35])
    slots = (25.0, -125.0)
    others = ((-45.0, 12.0), (65.0, 9.0), (125.0, 14.0), (5.0, 6.0))  # longitude and half width

    def angle(self, x: Tensor, at: float) -> Tensor:
        return (torch.remainder(x[..., 0] - at + 180, 360) - 180).abs()

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        earth = -0.00168 * torch.sin(2 * (x[..., 0] - 75.1) * math.pi / 180)  # its equator is no circle
        return rows(x[..., 1], earth + u[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [0.3]]).expand(*x.shape, 1)

    def target_level(self, x: Tensor) -> Tensor:
        near = torch.minimum(*(self.angle(x, at) for at in self.slots))
        return torch.maximum(near / 4 - 1, x[..., 1].abs() / 0.5 - 1)

    def avoid_level(self, x: Tensor) -> Tensor:
        slow = x[..., 1].abs() / 0.9 - 1
        close = [torch.maximum(self.angle(x, at) / width - 1, slow) for at, width in self.others]
        return torch.stack([*close, 5.5 - x[..., 1].abs()], -1).amin(-1)


class TwoLink(ReachAvoidProblem):
    """Bring the hand of an arm with two links to one of two bins past three posts, which no link may touch; rad and s.

    A cable limits the turn of the shoulder on either side. The hand comes to most places with the elbow on either side,
    and the elbow passes one of the posts at 2 mm.
    """

    horizon = 2.5
    states, controls = Box([-2.9, -2.6], [2.9, 2.6]), Box([-1.0, -1.4], [1.0, 1.4])
    links = (1.0, 0.8)
    posts = ((0.9, 0.75, 0.16), (-0.35, -1.15, 0.2), (-1.25, 0.5, 0.15))
    bins = ((0.1, 1.45, 0.22), (0.6, -1.1, 0.16))

    def joints(self, x: Tensor) -> tuple[Tensor, Tensor]:
        shoulder, both = x[..., 0], x[..., 0] + x[..., 1]
        elbow = self.links[0] * rows(shoulder.cos(), shoulder.sin())
        return elbow, elbow + self.links[1] * rows(both.cos(), both.sin())

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        sag = -0.15 * torch.cos(x[..., 0])
        return rows(u[..., 0] + sag, u[..., 1])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        zero = torch.zeros_like(x[..., 0])
        whip = 0.25 + 0.12 * (1 + x[..., 1].cos())  # a stretched arm shakes more
        return torch.stack([rows(whip, zero), rows(-0.3 * whip, zero + 0.45)], -1)

    def target_level(self, x: Tensor) -> Tensor:
        _, hand = self.joints(x)
        gaps = [(hand - hand.new_tensor([a, b])).norm(dim=-1) - r for a, b, r in self.bins]
        return torch.maximum(torch.stack(gaps, -1).amin(-1), -self.avoid_level(x))

    def avoid_level(self, x: Tensor) -> Tensor:
        elbow, hand = self.joints(x)
        gaps = [2.8 - x[..., 0].abs(), 2.5 - x[..., 1].abs()]
        for a, b, r in self.posts:
            post = x.new_tensor([a, b])
            for start, end in ((torch.zeros_like(elbow), elbow), (elbow, hand)):
                along = end - start
                share = ((post - start) * along).sum(-1) / along.square().sum(-1)
                nearest = start + share.clamp(0, 1).unsqueeze(-1) * along
                gaps.append((post - nearest).square().sum(-1).clamp(min=1e-12).sqrt() - r)
        return torch.stack(gaps, -1).amin(-1)


class FastRiver(ZermeloBoat):
    """Zermelo's boat with other constants: a current one and a half times as fast as the boat, and weaker noise."""

    horizon, current, noise = 5.0, 1.5, (0.15, 0.2)
    controls = Box([-1.0, -0.6], [1.0, 0.6])
    landing, landing_radius = (0.6, -0.55), 0.2
    rock, rock_radius = (-0.5, -0.3), 0.3


class Glider(ReachAvoidProblem):
    """Come to an airfield at a height of at least 0.2 km before dusk; the faster the flight, the faster it sinks.

    The states are the distance flown in km and the height in km; the control is the speed in km/h. Thermals lift the
    glider at two places. At most states the time to go allows for little more than the flight at full speed.
    """

    horizon = 0.6  # h
    states, controls = Box([0.0, 0.0], [50.0, 2.0]), Box([80.0], [200.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        distance, speed = x[..., 0], u[..., 0]
        lift = 6 * torch.exp(-(((distance - 20) / 3) ** 2)) + 4 * torch.exp(-(((distance - 38) / 2) ** 2))
        return rows(speed, lift - 2.0 - 0.0004 * (speed - 85).square())

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [4.0, 0.0], [0.0, 0.5])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(50 - x[..., 0], 0.2 - x[..., 1])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x[..., 1:]


class StraitFerry(ReachAvoidProblem):
    """A ferry has to come to one of two harbours on the far side of a strait, past an island; km and hours.

    The current is faster than the ferry except beside the shores. The controls are the speeds through the water along
    and across the strait.
    """

    horizon = 3.0
    states, controls = Box([-8.0, 0.0], [14.0, 8.0]), Box([-3.5, -2.5], [3.0, 2.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        current = 20.0 * x[..., 1] * (8.0 - x[..., 1]) / 64.0
        return u + rows(current, torch.zeros_like(current))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        sea = 0.6 + 0.7 * (math.pi * x[..., 1] / 8.0).sin() ** 2  # rougher in the middle
        return torch.diag_embed(rows(sea, 0.8 * sea))

    def target_level(self, x: Tensor) -> Tensor:
        large = (x - x.new_tensor([9.0, 6.6])).norm(dim=-1) - 1.2
        small = (x - x.new_tensor([-1.0, 7.0])).norm(dim=-1) - 0.8
        return torch.minimum(large, small)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        island = (x - x.new_tensor([3.0, 4.5])).norm(dim=-1) - 1.4
        along, across = x.unbind(-1)
        return rows(island, along + 8.0, 14.0 - along, across, 8.0 - across)


class TackingYacht(ReachAvoidProblem):
    """Sail to a windward mark in 6 minutes, past an L-shaped reef; a yacht makes no way within 30 degrees of the wind.

    Lengths are in hectometres. The heading is 0 straight into the wind, and the control is the rudder. Shifts of the
    wind and the current make the noise.
    """

    horizon = 6.0  # minutes
    states = Box([-2.5, -2.0, -math.pi], [2.5, 2.5, math.pi], periodic=[2])
    controls = Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        heading = x[..., 2]
        speed = 1.8 * ((heading.abs() - 0.52) / 0.35).clamp(0.0, 1.0)
        return torch.stack([speed * heading.sin() + 0.2, speed * heading.cos() - 0.1, 2.5 * u[..., 0]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(x.new_tensor([0.2, 0.2, 0.5]).expand_as(x))

    def target_level(self, x: Tensor) -> Tensor:
        return (x[..., :2] - x.new_tensor([0.0, 1.8])).norm(dim=-1) - 0.5

    def avoid_level(self, x: Tensor) -> Tensor:
        east, north = x[..., 0], x[..., 1]
        shank = torch.maximum((east - 1.0).abs() - 0.2, (north - 0.1).abs() - 0.9)
        foot = torch.maximum((east - 0.3).abs() - 0.9, (north + 0.6).abs() - 0.2)
        return torch.minimum(shank, foot)


class TwoDoors(ReachAvoidProblem):
    """Reach the target behind a wall through a narrow door, at which the noise is strong, or through a wide one."""

    horizon = 6.0
    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 1.2 * u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        noise = 0.2 + 0.3 * (-4 * (x - x.new_tensor([0.0, -0.8])).square().sum(-1)).exp()
        return torch.diag_embed(rows(noise, noise))

    def target_level(self, x: Tensor) -> Tensor:
        return (x - x.new_tensor([1.4, -0.8])).norm(dim=-1) - 0.3

    def avoid_constraints(self, x: Tensor) -> Tensor:
        wall, narrow, wide = x[..., 0].abs() - 0.15, 0.2 - (x[..., 1] + 0.8).abs(), 0.45 - (x[..., 1] - 1.2).abs()
        return torch.cat([rows(wall, narrow, wide).amax(-1, keepdim=True), 2.0 - x.abs()], -1)
