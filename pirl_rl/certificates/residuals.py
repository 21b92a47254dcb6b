"""By how much V of the networks misses the equation in the interior, and its data on the parabolic boundary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from pirl_rl.certificates.bounds import order_of_quantile
from pirl_rl.certificates.field import Field
from pirl_rl.certificates.lipschitz import BATCHES, STEP, Lipschitz, largest_from_mean, lipschitz_constant, neighbours
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.faces import find_faces
from pirl_rl.sampling.initial_states import sample_interior

SHARE = 0.01
"""The share of the points about which the bound of a residual says nothing."""

MARGIN = 1.01
"""Faces in the box of states, widened by this factor, count: those along its edges must not be lost to rounding."""


@dataclass(frozen=True)
class Region:
    """Independent points of a part of D and its boundary: `inside`, its end at tau = 0 (`start`), or the `faces`.

    Attributes:
        kind: which part.
        problem: gives the box of states and the sets.
        tau: times to go (N,) in s.
        x: states (N, n) in SI units.
    """

    kind: Literal["inside", "start", "faces"]
    problem: ReachAvoidProblem
    tau: Tensor
    x: Tensor

    @property
    def dim(self) -> int:
        """The number of dimensions of the part."""
        return self.x.shape[-1] + (self.kind == "inside")

    def beside(self, rng: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Points tau (N,) and x (N, n) at the distance `STEP` from these, and which of them (N,) belong to the part.

        The distance is that in coordinates in which (0, T) x states is [-1, 1]^(1 + n).
        """
        states, horizon = self.problem.states, self.problem.horizon
        z = torch.cat([2 * self.tau.unsqueeze(-1) / horizon - 1, states.normalize(self.x)], -1)
        moves = torch.ones(z.shape[-1], dtype=torch.bool)
        moves[0] = self.kind != "start"
        z = neighbours(z, moves, rng)
        tau, x = horizon * (1 + z[:, 0]) / 2, states.wrap(states.denormalize(z[:, 1:]))
        # V is smooth across a face, where it has the same data on both sides.
        return tau, x, self.problem.interior(x) | (self.kind == "faces")


class Part(NamedTuple):
    """|g| at the points of a region.

    Attributes:
        mean: the mean of |g|.
        almost: with the confidence asked for, |g| is at most this at all but `SHARE` of the points, exactly.
        largest: the largest |g| of the sample.
        lipschitz: the Lipschitz constant of g, in coordinates in which (0, T) x states is [-1, 1]^(1 + n).
        points: the number of points.
        everywhere: the largest |g| that its mean and its Lipschitz constant leave possible.
    """

    mean: float
    almost: float
    largest: float
    lipschitz: Lipschitz
    points: int
    everywhere: float

    def numbers(self, name: str) -> dict[str, float | None]:
        """All of them by name, after the name of the part."""
        own = self._asdict()
        steep = {f"lipschitz_{key}": entry for key, entry in own.pop("lipschitz")._asdict().items()}
        return {f"{name}_{key}": entry for key, entry in (own | steep).items()}


def measure(field: Field, points: int, confidence: float, rng: torch.Generator) -> tuple[Region, dict[str, Part]]:
    """The residual L^pi V `inside`, and V - l_eps at the `start`, tau = 0, and on the `faces` in the box of states.

    Args:
        field: the problem, V and its residual.
        points: the number of points inside and at tau = 0, uniform; those of which V is known are left out.
        confidence: the level of the bounds, in (0.5, 1).
        rng: draws the points. Those on the faces follow the law of `find_faces`, which is not uniform.

    Returns:
        The points inside, and the parts by name; there are no `faces` where too few are in the box.

    Raises:
        ArgumentError: there are too few points for the confidence.
    """
    problem = field.problem
    x = sample_interior(problem, problem.states, points, rng, torch.float64)
    x = x[~problem.unreachable(x)]
    if not _enough(len(x), confidence):
        raise ArgumentError(
            "corollary: expected more states of the box from which the target is not out of reach, for a confidence of "
            f"{confidence:g}, got {len(x)} of {points}"
        )
    inside = Region("inside", problem, _late(problem, len(x), rng), x)
    start = Region("start", problem, torch.zeros_like(inside.tau), x)
    parts = {
        "inside": _part(field.residual, inside, confidence, rng),
        "start": _part(lambda t, y: field.value(t, y) - problem.boundary_value(y), start, confidence, rng),
    }
    found, values, _ = find_faces(problem, rng)
    near = problem.states.expand(MARGIN).contains(found).nonzero().flatten()
    if _enough(len(near), confidence):
        near = near[torch.randperm(len(near), generator=rng)]
        y, data = found[near].double(), values[near].double()
        faces = Region("faces", problem, _late(problem, len(y), rng), y)
        parts["faces"] = _part(lambda t, y: field.value(t, y) - data, faces, confidence, rng)
    return inside, parts


def _late(problem: ReachAvoidProblem, count: int, rng: torch.Generator) -> Tensor:
    """Times to go (count,), uniform in (0, T]."""
    return problem.horizon * (1 - torch.rand(count, generator=rng, dtype=torch.float64))


def _enough(points: int, confidence: float) -> bool:
    """Whether so many points suffice for the fit of slopes and for the quantile."""
    return points >= 2 * BATCHES and order_of_quantile(points, SHARE, confidence) is not None


def _part(g: Callable[[Tensor, Tensor], Tensor], region: Region, confidence: float, rng: torch.Generator) -> Part:
    """|g| and the slopes of g, a function of tau (N,) and x (N, n), at the points of a region."""
    here, (tau, x, belongs) = g(region.tau, region.x), region.beside(rng)
    slopes = ((g(tau, x) - here).abs() / STEP)[belongs]
    size = here.abs().numpy()
    order = order_of_quantile(len(size), SHARE, confidence)
    assert order is not None  # of enough points
    steep = lipschitz_constant(slopes.numpy(), confidence)
    mean, largest = float(size.mean()), float(size.max())
    everywhere = max(largest, largest_from_mean(mean, steep.stated, region.dim))
    return Part(mean, float(np.sort(size)[order - 1]), largest, steep, len(size), everywhere)
