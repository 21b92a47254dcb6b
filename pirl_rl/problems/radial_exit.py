"""Exit of a diffusion in n dimensions from a shell between two spheres, a benchmark that is no ridge function.

The uncontrolled state is an Ornstein-Uhlenbeck process, and the control scales a radial drift. So the distance from the
origin is a diffusion of its own, the radial process of Karatzas and Shreve, Brownian Motion and Stochastic Calculus,
Sec. 3.3.C, with two more terms of drift, and one partial differential equation in one dimension gives the exact value.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.payoffs import Payoff
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.interval_exit import IntervalExit
from pirl_rl.sets import Box, Plane


class RadialExit(ReachAvoidProblem):
    """dX = (u X/|X| - X/2) dt + dW in R^n with |u| <= 1: reach |x| <= sqrt(n) - 1 before |x| >= sqrt(n) + 1 in T = 1 s.

    The radius R = |X| obeys dR = (u - R/2 + (n - 1)/(2 R)) dt + dB with one Brownian motion B, so V depends on |x| and
    falls with it, and the optimal control is u = -1. The law of the uncontrolled state tends to the standard normal
    law, whose radius is sqrt(n) give or take 0.7; this and the box, in which |x| is about sqrt(n) too, make problems of
    all dimensions alike.

    Args:
        payoff: replaces the indicator of the target.
        horizon: replaces the horizon, in s.
        dim: the number n of states, at least 2.

    Attributes:
        inner: the radius of the target.
        outer: the radius beyond which B lies.

    Raises:
        ArgumentError: `dim` is not an integer of at least 2.
    """

    horizon = 1.0
    controls = Box([-1.0], [1.0])

    def __init__(self, payoff: Payoff | None = None, horizon: float | None = None, dim: int = 2):
        super().__init__(payoff, horizon)
        if not (isinstance(dim, int) and dim >= 2):
            raise ArgumentError(f"RadialExit.dim: expected an integer >= 2, got {dim!r}")
        half_width = math.sqrt(3)  # the mean square of a coordinate that is uniform in the box is 1
        self.states = Box([-half_width] * dim, [half_width] * dim)
        self.inner, self.outer = math.sqrt(dim) - 1, math.sqrt(dim) + 1
        self._radial_value = IntervalExit(
            lambda r: -2 * r - r**2 / 2 + (dim - 1) * torch.log(r), self.inner, self.outer
        )

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        # Inside the target the direction x/|x| is shortened, so that it is defined at the origin.
        return u * x / x.norm(dim=-1, keepdim=True).clamp(min=self.inner) - x / 2

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.eye(x.shape[-1], dtype=x.dtype, device=x.device).expand(*x.shape, x.shape[-1])

    def target_level(self, x: Tensor) -> Tensor:
        return x.norm(dim=-1) - self.inner

    def avoid_level(self, x: Tensor) -> Tensor:
        return self.outer - x.norm(dim=-1)

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """The probability (*) that the radius under u = -1 falls to `inner` within tau and before it grows to `outer`.

        It is a series of eigenfunctions, see `pirl_rl.problems.interval_exit`.
        """
        return self._radial_value(tau, x.norm(dim=-1))

    def optimal_control(self, tau: Tensor, x: Tensor) -> Tensor:
        return -torch.ones_like(x[..., :1])

    @property
    def planes(self) -> dict[str, Plane]:
        """A section through the origin: the first half of the coordinates have one value, the others a second one."""
        n = self.states.dim
        half = n // 2
        columns = torch.zeros(2, n, dtype=torch.float64)
        columns[0, :half], columns[1, half:] = 1 / math.sqrt(half), 1 / math.sqrt(n - half)
        reach = self.outer
        section = Plane(
            ("length along the first half of the coordinates", "length along the second half"),
            Box([-reach, -reach], [reach, reach]),
            lambda points: points @ columns.to(points),
            lambda x: x @ columns.mT.to(x),
        )
        return {"halves": section}
