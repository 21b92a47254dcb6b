"""Boxes in space and time, each within one cell of a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from pirl_rl.proofs.affine import Affine


@dataclass(frozen=True)
class Boxes:
    """N boxes: the part place + share [-1, 1]^d of cells, in coordinates in which a cell is [-1, 1]^d.

    Attributes:
        edges: the edges of the cells along each axis.
        cell: numbers (N, d) of the cells.
        place: centres (N, d) in the cells' coordinates.
        share: halves of the sides (N, d) in the cells' coordinates.
    """

    edges: list[np.ndarray]
    cell: Tensor
    place: Tensor
    share: Tensor

    @classmethod
    def cells(cls, edges: list[np.ndarray]) -> Boxes:
        """All cells of a mesh."""
        numbers = torch.cartesian_prod(*(torch.arange(len(axis) - 1) for axis in edges)).reshape(-1, len(edges))
        zeros = torch.zeros(numbers.shape, dtype=torch.float64)
        return cls(edges, numbers, zeros, torch.ones_like(zeros))

    @classmethod
    def join(cls, parts: Sequence[Boxes]) -> Boxes:
        """The boxes of all parts, which have the same edges."""
        rows = [(part.cell, part.place, part.share) for part in parts]
        return cls(parts[0].edges, *(torch.cat(entry) for entry in zip(*rows, strict=True)))

    def __len__(self) -> int:
        return len(self.cell)

    def __getitem__(self, index) -> Boxes:
        return Boxes(self.edges, self.cell[index], self.place[index], self.share[index])

    def around(self, others: Boxes) -> Boxes:
        """Those boxes whose cells contain one of the other boxes, or are next to such a cell."""
        marked = np.zeros([len(axis) - 1 for axis in self.edges], bool)
        marked[tuple(others.cell.T.numpy())] = True
        marked = maximum_filter(marked, size=3)
        return self[torch.from_numpy(marked[tuple(self.cell.T.numpy())])]

    def split(self, size: int) -> list[Boxes]:
        """Parts of at most `size` boxes."""
        return [self[slice(start, start + size)] for start in range(0, len(self), size)]

    def _ends(self) -> tuple[Tensor, Tensor]:
        low, high = [], []
        for j, axis in enumerate(self.edges):
            edges = torch.from_numpy(axis)
            low.append(edges[self.cell[:, j]])
            high.append(edges[self.cell[:, j] + 1])
        return torch.stack(low, -1), torch.stack(high, -1)

    @property
    def centre(self) -> Tensor:
        """The centres (N, d) in the units of the axes."""
        low, high = self._ends()
        return (low + high) / 2 + (high - low) / 2 * self.place

    @property
    def half_width(self) -> Tensor:
        """Halves of the sides (N, d) in the units of the axes."""
        low, high = self._ends()
        return (high - low) / 2 * self.share

    def coordinates(self) -> Affine:
        """The points (N, d) of the boxes as affine forms."""
        return Affine.of_box(self.centre, self.half_width)

    def at_end(self, axis: int, cell: int, end: int) -> Boxes:
        """The lower (end = -1) or upper (end = 1) ends along an axis of the boxes in a cell of that axis."""
        chosen = self[self.cell[:, axis] == cell]
        low, high = -torch.ones_like(chosen.share), torch.ones_like(chosen.share)
        low[:, axis] = high[:, axis] = end
        return chosen.part(low, high)

    def part(self, low: Tensor, high: Tensor) -> Boxes:
        """The parts with coordinates e in [low, high], each (N, d) within [-1, 1]."""
        return Boxes(self.edges, self.cell, self.place + self.share * (low + high) / 2, self.share * (high - low) / 2)

    def halves(self, axis: Tensor) -> Boxes:
        """Both halves (2 N) along an axis (N,) of each box."""
        chosen = torch.nn.functional.one_hot(axis, self.cell.shape[-1]).double()
        share = self.share * (1 - chosen / 2)
        parts = [Boxes(self.edges, self.cell, self.place + sign * chosen * share, share) for sign in (-1, 1)]
        return Boxes.join(parts)
