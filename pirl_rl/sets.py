"""Boxes and the algebra of level sets.

A closed set S is described by a level function g with S = {x : g(x) <= 0}. This one function gives membership,
crossings of the boundary between two time steps, and contours. The level of states (*, n) has shape (*). Levels that
are compared with each other are counted in units of their own size first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError

UNIT_STATES, USUAL = 256, (2.0**-20, 2.0**20)
"""The number of random states whose levels show the unit of a level, and the range of sizes that need no other unit."""

COMPARABLE = 8.0
"""The largest quotient of the deviations of two levels of one set with which the levels are compared as they are.

The nearest of several faces is taken to be that of the largest or the smallest level.
"""


class Box:
    """The box {x : low <= x <= high} in R^n, in the units of the problem.

    A periodic axis, such as that of an angle, is a circle: coordinates that differ by a multiple of the period
    high - low are the same point, and the box has no edge there.

    Args:
        low: lower corner, n finite numbers.
        high: upper corner, n finite numbers, each above that of `low`.
        periodic: numbers of the periodic axes, counted from 0.

    Raises:
        ArgumentError: the corners are no lists of numbers, have different lengths, are empty, not finite or not
            ordered, or `periodic` names an axis that does not exist, or names one twice.
    """

    def __init__(self, low: Sequence[float], high: Sequence[float], periodic: Sequence[int] = ()):
        try:
            self.low = tuple(float(value) for value in low)
            self.high = tuple(float(value) for value in high)
        except (TypeError, ValueError):
            raise ArgumentError(
                f"Box: expected the lower and the upper corner as two lists of numbers, got {low!r} and {high!r}"
            ) from None
        if len(self.low) != len(self.high) or not self.low:
            raise ArgumentError(
                f"Box: low and high need the same length >= 1, got {len(self.low)} and {len(self.high)}"
            )
        for axis, (a, b) in enumerate(zip(self.low, self.high, strict=True)):
            if not (math.isfinite(a) and math.isfinite(b) and a < b):
                raise ArgumentError(f"Box: axis {axis} needs finite low < high, got low={a}, high={b}")
        self.periodic = _axes(periodic, len(self.low))
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

    def wrap(self, x: Tensor) -> Tensor:
        """Bring the periodic coordinates of points (*, n) into [low, high); the others stay as they are.

        A coordinate that already lies there keeps every digit. The derivative in x is the identity.
        """
        if not self.periodic:
            return x
        columns = list(x.unbind(-1))
        for axis in self.periodic:
            columns[axis] = _wrapped(columns[axis], self.low[axis], self.high[axis])
        # Each coordinate is contiguous in memory, because problems unbind states into coordinates.
        return torch.stack(columns).movedim(0, -1)

    def within_period(self, function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
        """The function of points (*, n) that brings them into the period by `wrap` and gives `function` there."""
        return lambda x: function(self.wrap(x))

    def contains(self, x: Tensor) -> Tensor:
        """Whether points (*, n) lie in the closed box, (*) bool; every coordinate of a periodic axis does."""
        inside = self.normalize(x).abs() <= 1
        for axis in self.periodic:
            inside[..., axis] = True
        return inside.all(-1)

    def sample(
        self,
        count: int,
        rng: torch.Generator | None = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw points (count, n) uniformly from the box."""
        unit = torch.rand(count, self.dim, generator=rng, dtype=dtype, device=device)
        # Rounding may put a coordinate on the upper end of a period, which is its lower end.
        return self.wrap(self.denormalize(2 * unit - 1))

    def expand(self, factor: float) -> Box:
        """A box with the same center and `factor` times the widths; a periodic axis keeps its period."""
        middle = [(a + b) / 2 for a, b in zip(self.low, self.high, strict=True)]
        half = [factor * (b - a) / 2 for a, b in zip(self.low, self.high, strict=True)]
        low = [m - h for m, h in zip(middle, half, strict=True)]
        high = [m + h for m, h in zip(middle, half, strict=True)]
        for axis in self.periodic:
            low[axis], high[axis] = self.low[axis], self.high[axis]
        return Box(low, high, self.periodic)

    def _key(self) -> tuple[tuple[float, ...], tuple[float, ...], tuple[int, ...]]:
        return self.low, self.high, self.periodic

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Box) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        periodic = f", periodic={list(self.periodic)}" if self.periodic else ""
        return f"Box({list(self.low)}, {list(self.high)}{periodic})"


def _axes(periodic: Sequence[int], dim: int) -> tuple[int, ...]:
    """The numbers of the periodic axes in ascending order, after a check that a box of `dim` axes has them."""
    known = isinstance(periodic, Sequence) and all(type(axis) is int and 0 <= axis < dim for axis in periodic)
    if not known or len(set(periodic)) < len(periodic):
        raise ArgumentError(
            f"Box: periodic needs a list of different axis numbers from 0 to {dim - 1}, got {periodic!r}"
        )
    return tuple(sorted(periodic))


def _wrapped(x: Tensor, low: float, high: float) -> Tensor:
    """The coordinates x (*), each moved by a multiple of high - low into [low, high)."""
    period = high - low
    moved = x - period * torch.floor((x - low) / period)
    # Rounding may leave a coordinate next to an end of the period, and both ends are the same point.
    moved = torch.where((moved < low) | (moved >= high), torch.full_like(x, low), moved)
    return torch.where((x >= low) & (x < high), x, moved)


@dataclass(frozen=True)
class Plane:
    """A two-dimensional section of the state space, for figures and for the initial states of episodes.

    Attributes:
        axes: names of the two coordinates, with units.
        box: range of the two coordinates; figures break paths at the ends of its periodic axes.
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


def units_of_levels(levels: Callable[[Tensor], Tensor], states: Box) -> list[float]:
    """Powers of two by which levels (*, k) are divided, or none where all have a usual size and vary alike.

    A level has the size of its median absolute deviation over the box, or of its median where it hardly varies.

    Args:
        levels: maps states (*, n) to the levels (*, k) of one set.
        states: the box of states.
    """
    sampled = levels(states.sample(UNIT_STATES, torch.Generator().manual_seed(0), torch.float64))
    sampled = torch.where(sampled.isfinite(), sampled, torch.nan)
    deviation = (sampled - sampled.nanmedian(0).values).abs().nanmedian(0).values
    size = torch.where(deviation > 0, deviation, sampled.abs().nanmedian(0).values)
    known = size[size > 0]
    usual = ((known >= USUAL[0]) & (known <= USUAL[1])).all()
    if not len(known) or (usual and known.amax() <= COMPARABLE * known.amin()):
        return []
    return [2.0 ** math.frexp(one)[1] if one > 0 else 1.0 for one in size.tolist()]


def in_units(levels: Tensor, units: Sequence[float]) -> Tensor:
    """The levels (*, k), each divided by its unit, or as they are where there are no units.

    Args:
        levels: (*, k).
        units: k numbers or none, see `units_of_levels`.
    """
    if not units:
        return levels
    return torch.stack([one / unit for one, unit in zip(levels.unbind(-1), units, strict=True)], -1)
