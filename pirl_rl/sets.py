"""Boxes and the algebra of level sets.

A closed set S is described by a level function g with S = {x : g(x) <= 0}. This one function gives membership,
crossings of the boundary between two time steps, and contours. The level of states (*, n) has shape (*).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError


class Box:
    """The box {x : low <= x <= high} in R^n, in the units of the problem.

    Args:
        low: lower corner, n finite numbers.
        high: upper corner, n finite numbers, each above that of `low`.

    Raises:
        ArgumentError: the corners have different lengths, are empty, not finite or not ordered.
    """

    def __init__(self, low: Sequence[float], high: Sequence[float]):
        self.low = tuple(float(value) for value in low)
        self.high = tuple(float(value) for value in high)
        if len(self.low) != len(self.high) or not self.low:
            raise ArgumentError(
                f"Box: low and high need the same length >= 1, got {len(self.low)} and {len(self.high)}"
            )
        for axis, (a, b) in enumerate(zip(self.low, self.high, strict=True)):
            if not (math.isfinite(a) and math.isfinite(b) and a < b):
                raise ArgumentError(f"Box: axis {axis} needs finite low < high, got low={a}, high={b}")
        self._cache: dict[tuple[torch.dtype, torch.device], tuple[Tensor, Tensor]] = {}

    @property
    def dim(self) -> int:
        """The dimension n."""
        return len(self.low)

    def center_and_half_width(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """The center and half the widths, each (n,), with the dtype and the device of `like`."""
        key = (like.dtype, like.device)
        if key not in self._cache:
            low, high = (torch.tensor(corner, dtype=like.dtype, device=like.device) for corner in (self.low, self.high))
            self._cache[key] = ((low + high) / 2, (high - low) / 2)
        return self._cache[key]

    def normalize(self, x: Tensor) -> Tensor:
        """Map physical points (*, n) to coordinates in which the box is [-1, 1]^n; points outside are not clipped."""
        center, half_width = self.center_and_half_width(x)
        return (x - center) / half_width

    def denormalize(self, z: Tensor) -> Tensor:
        """Map coordinates (*, n), in which the box is [-1, 1]^n, to physical points (*, n)."""
        center, half_width = self.center_and_half_width(z)
        return center + half_width * z

    def contains(self, x: Tensor) -> Tensor:
        """Whether points (*, n) lie in the closed box, (*) bool."""
        return (self.normalize(x).abs() <= 1).all(-1)

    def sample(
        self,
        count: int,
        rng: torch.Generator | None = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw points (count, n) uniformly from the box."""
        unit = torch.rand(count, self.dim, generator=rng, dtype=dtype, device=device)
        return self.denormalize(2 * unit - 1)

    def expand(self, factor: float) -> Box:
        """A box with the same center and `factor` times the widths."""
        middle = [(a + b) / 2 for a, b in zip(self.low, self.high, strict=True)]
        half = [factor * (b - a) / 2 for a, b in zip(self.low, self.high, strict=True)]
        return Box(
            [m - h for m, h in zip(middle, half, strict=True)], [m + h for m, h in zip(middle, half, strict=True)]
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Box) and (self.low, self.high) == (other.low, other.high)

    def __hash__(self) -> int:
        return hash((self.low, self.high))

    def __repr__(self) -> str:
        return f"Box({list(self.low)}, {list(self.high)})"


@dataclass(frozen=True)
class Plane:
    """A two-dimensional section of the state space, for figures and for the initial states of episodes.

    Attributes:
        axes: names of the two coordinates, with units.
        box: range of the two coordinates.
        embed: maps points of the plane (*, 2) to states (*, n).
        project: maps states (*, n) to the coordinates of the plane (*, 2).
    """

    axes: tuple[str, str]
    box: Box
    embed: Callable[[Tensor], Tensor]
    project: Callable[[Tensor], Tensor]


def union(*levels: Tensor) -> Tensor:
    """The level (*) of the union of sets with the given levels (*)."""
    return torch.stack(levels).amin(0)


def intersection(*levels: Tensor) -> Tensor:
    """The level (*) of the intersection of sets with the given levels (*)."""
    return torch.stack(levels).amax(0)


def complement(level: Tensor) -> Tensor:
    """The level (*) of the closed complement of a set with the given level (*)."""
    return -level


def difference(level: Tensor, other: Tensor) -> Tensor:
    """The level (*) of the first set without the interior of the second, from their levels (*)."""
    return intersection(level, complement(other))


def band(value: Tensor, center: Tensor | float, half_width: float) -> Tensor:
    """The level (*) of the set {|value - center| <= half_width}."""
    return (value - center).abs() - half_width
