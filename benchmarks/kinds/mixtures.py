"""A rotor in magnetic bearings and a deformable mirror: independent subsystems in mixed coordinates.

Each subsystem has its own controls, noise and bounds, so that the probability of staying within all bounds is the
product of those of the subsystems, which a grid finds. In the coordinates of the user, sums and differences of theirs,
nothing shows that.
"""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.kinds.shapes import rows
from pirl_rl import Box, ReachAvoidProblem


class Mixture(ReachAvoidProblem):
    """Independent invariance problems with one control each and states z, seen in the coordinates x = mix z.

    Attributes:
        parts: the subsystems, each with the numbers of its entries of z. Their controls are those of x, in order.
        mix: an invertible matrix (n, n), by rows.
    """

    objective = "invariance"
    parts: tuple[tuple[ReachAvoidProblem, list[int]], ...]
    mix: list[list[float]]

    def split(self, x: Tensor) -> list[tuple[ReachAvoidProblem, Tensor]]:
        """The subsystems, each with its states (*, n_i) at x (*, n)."""
        z = x @ torch.linalg.inv(torch.tensor(self.mix, dtype=torch.float64)).T.to(x)
        return [(part, z[..., entries]) for part, entries in self.parts]

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        rates = {}
        for i, (part, z) in enumerate(self.split(x)):
            rates |= dict(zip(self.parts[i][1], part.drift(z, u[..., i : i + 1]).unbind(-1), strict=True))
        return rows(*(rates[entry] for entry in sorted(rates))) @ x.new_tensor(self.mix).T

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        mix, columns = x.new_tensor(self.mix), []
        for i, (part, z) in enumerate(self.split(x)):
            columns.append(mix[:, self.parts[i][1]] @ part.diffusion(z, u[..., i : i + 1]))
        return torch.cat(columns, -1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([part.avoid_constraints(z) for part, z in self.split(x)], -1)


class Heave(ReachAvoidProblem):
    """The middle of a rotor between magnets, which pull it ever more to the nearer side; in micrometres and ms."""

    objective = "invariance"
    horizon = 15.0
    states, controls = Box([-120.0, -30.0], [120.0, 30.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        place, speed = x.unbind(-1)
        return rows(speed, 0.035 * place + 3.0 * u[..., 0] - 0.02 * speed)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [3.8]]).expand(*x.shape, 1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(120 - x[..., 0].abs(), 30 - x[..., 1].abs())


class Tilt(ReachAvoidProblem):
    """The tilt of the rotor: a spring with a hard stop, whirl that feeds itself, and a noisy, lopsided actuator."""

    objective = "invariance"
    horizon = 15.0
    states, controls = Box([-75.0, -30.0], [75.0, 30.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        place, speed = x.unbind(-1)
        whirl = 0.22 * speed * (1 - (speed / 25).square())
        push = torch.where(u[..., 0] > 0, 4.0, 2.6) * u[..., 0]
        stop = 0.3 * (place.abs() - 50).clamp(min=0) * place.sign()
        return rows(speed, -0.15 * place - stop + whirl + push)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        strength = 2.8 + 2.5 * u[..., 0].abs()
        return rows(torch.zeros_like(strength), strength).unsqueeze(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(75 - x[..., 0].abs(), 26 - x[..., 1].abs())


class Bearing(Mixture):
    """Hold a rotor in two magnetic bearings for 15 ms. States are the gaps at both ends and their speeds; in um, ms."""

    horizon = 15.0
    states = Box([-95.0, -95.0, -26.0, -26.0], [95.0, 95.0, 26.0, 26.0])
    controls = Box([-1.0, -1.0], [1.0, 1.0])
    parts = ((Heave(), [0, 2]), (Tilt(), [1, 3]))
    mix = [[1.0, 1.0, 0, 0], [1.0, -1.0, 0, 0], [0, 0, 1.0, 1.0], [0, 0, 1.0, -1.0]]


class Piston(ReachAvoidProblem):
    """The piston of a mirror and its rate on a soft spring, shaken by the mount."""

    objective = "invariance"
    horizon = 2.0
    states, controls = Box([-1.5, -4.0], [1.5, 4.0]), Box([-2.5], [2.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(x[..., 1], u[..., 0] - 4 * x[..., 0] - 0.3 * x[..., 1])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [1.4]]).expand(*x.shape, 1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(1.4 - x[..., 0].abs(), 3.2 - x[..., 1].abs())


class Tip(ReachAvoidProblem):
    """The tip of the mirror and its rate; it is top-heavy, and the wind is stronger when it stands out."""

    objective = "invariance"
    horizon = 2.0
    states, controls = Box([-1.5, -4.0], [1.5, 4.0]), Box([-3.0], [3.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        tip, rate = x.unbind(-1)
        return rows(rate, 1.5 * torch.sin(tip) + u[..., 0] - 1.2 * rate * rate.abs())

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        strength = 0.65 + 0.5 * x[..., 0].abs()
        return rows(torch.zeros_like(strength), strength).unsqueeze(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return rows(1.25 - x[..., 0].abs(), 3.0 - x[..., 1].abs())


class Focus(ReachAvoidProblem):
    """The focus of the mirror, which creeps with the warmth to one side; a strong heater and a weak fan act on it."""

    objective = "invariance"
    horizon = 2.0
    states, controls = Box([-1.6], [1.6]), Box([-0.4], [1.6])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u - 0.5 - 0.3 * x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.42 + 0.1 * x.abs()).unsqueeze(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([1.5 - x, x + 1.2], -1)


class Astigmatism(ReachAvoidProblem):
    """The saddle of the mirror: a thin plate that buckles to either side; a stronger voltage has more noise."""

    objective = "invariance"
    horizon = 2.0
    states, controls = Box([-1.4], [1.4]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.9 * x - 0.2 * x**3 + 1.3 * u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.32 + 0.45 * u.square()).unsqueeze(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1.3 - x.abs()


class Mirror(Mixture):
    """Hold a mirror in shape for two seconds. States are four gauges at its corners and two of rates; in um, s."""

    horizon = 2.0
    states = Box([-1.0] * 4 + [-2.2] * 2, [1.0] * 4 + [2.2] * 2)
    controls = Box([-2.5, -3.0, -0.4, -1.0], [2.5, 3.0, 1.6, 1.0])
    parts = ((Piston(), [0, 4]), (Tip(), [1, 5]), (Focus(), [2]), (Astigmatism(), [3]))
    mix = [
        [0.5, 0.5, 0.5, 0.5, 0, 0],
        [0.5, 0.5, -0.5, -0.5, 0, 0],
        [0.5, -0.5, 0.5, -0.5, 0, 0],
        [0.5, -0.5, -0.5, 0.5, 0, 0],
        [0, 0, 0, 0, 0.8, 0.6],
        [0, 0, 0, 0, 0.6, -0.8],
    ]
