"""Branch and bound: the proof of a condition on all points of a set of boxes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.proofs.boxes import Boxes

CHUNK = 8_192
"""The number of boxes that are bounded at once."""

Check = Callable[[Boxes], tuple[Tensor, Tensor]]
"""The margin (N,) with which a condition holds on each of N boxes, and the axis (N,) along which to halve it."""


@dataclass(frozen=True)
class Outcome:
    """What is known of a condition.

    Attributes:
        left: the boxes on which it was not proved with the wanted margin.
        margin: that with which it holds everywhere.
        bounded: the number of boxes that were bounded.
    """

    left: Boxes
    margin: float
    bounded: int

    @property
    def proved(self) -> bool:
        return not len(self.left)


def prove(check: Check, boxes: Boxes, margin: float, halvings: int, most: int) -> Outcome:
    """Prove a condition on boxes, by halving those on which it is not proved.

    Args:
        check: bounds the margin with which the condition holds.
        boxes: the boxes to begin with.
        margin: the wanted margin.
        halvings: the number of times that a box may be halved.
        most: the largest number of boxes that are halved at once; when more resist, they are left. In four dimensions
            those of a condition that fails would soon be millions.
    """
    bounded = 0
    for number in range(halvings + 1):
        left, axes, needed = [boxes[:0]], [torch.zeros(0, dtype=torch.long)], margin
        for part in boxes.split(CHUNK):
            margins, axis = check(part)
            margins = margins.nan_to_num(nan=torch.inf)  # what cannot be computed is not proved
            resists = margins > margin
            left.append(part[resists])
            axes.append(axis[resists])
            needed = max(needed, margins.max().item())
        bounded += len(boxes)
        boxes = Boxes.join(left)
        if not len(boxes) or len(boxes) > most or number == halvings:
            break
        boxes = boxes.halves(torch.cat(axes))
    return Outcome(boxes, needed, bounded)
