"""Branch and bound: the proof of a condition on all points of a set of boxes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.proofs.boxes import Boxes

CHUNK = 20_000
"""The number of boxes that are bounded at once."""

Check = Callable[[Boxes], tuple[Tensor, Tensor]]
"""Whether a condition is proved on each of N boxes (N,), and the axis (N,) along which to halve the others."""


@dataclass(frozen=True)
class Outcome:
    """The boxes on which a condition was not proved, and the number of boxes that were bounded."""

    left: Boxes
    bounded: int

    @property
    def proved(self) -> bool:
        return not len(self.left)


def prove(check: Check, boxes: Boxes, halvings: int) -> Outcome:
    """Prove a condition on boxes, by halving those on which it is not proved.

    Args:
        check: bounds the condition on boxes.
        boxes: the boxes to begin with.
        halvings: the number of times that a box may be halved.
    """
    bounded = 0
    for _ in range(halvings + 1):
        undecided = []
        for start in range(0, len(boxes), CHUNK):
            part = boxes[slice(start, start + CHUNK)]
            proved, axis = check(part)
            undecided.append((part[~proved], axis[~proved]))
            bounded += len(part)
        left = Boxes(boxes.edges, *(torch.cat([getattr(part, name) for part, _ in undecided]) for name in NAMES))
        if not len(left):
            return Outcome(left, bounded)
        boxes = left.halves(torch.cat([axis for _, axis in undecided]))
    return Outcome(left, bounded)


NAMES = ("cell", "place", "share")
