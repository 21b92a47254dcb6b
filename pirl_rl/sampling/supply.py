"""A supply of initial states, which are drawn many at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Draw = Callable[[int], tuple[Tensor, Tensor]]
"""Draws a number of initial states: control steps to go (count,) and states (count, n)."""


class Supply:
    """Initial states, drawn `size` at a time and given out one after the other.

    In each step of an environment only a few episodes end. To draw a few states costs nearly as much as to draw
    thousands, so that drawing them for each step would be a third of the time that collection takes.

    Args:
        size: the number of initial states of a draw, and the most that can be taken at once.
    """

    def __init__(self, size: int):
        self.size = size
        self._steps, self._states = torch.empty(0, dtype=torch.int64), torch.empty(0)

    def take(self, count: int, draw: Draw) -> tuple[Tensor, Tensor]:
        """Take `count` initial states, control steps to go (count,) and states (count, n); `draw` gives new ones."""
        if len(self._steps) < count:
            # The few that are left are dropped: they do not depend on what was taken, so that this adds no bias.
            self._steps, self._states = draw(self.size)
        steps, self._steps = self._steps[:count], self._steps[count:]
        states, self._states = self._states[:count], self._states[count:]
        return steps, states  # on the CPU where they come from a checkpoint

    def state_dict(self) -> dict[str, Any]:
        """The initial states that are left, which an exact continuation needs."""
        left = {"steps": self._steps.clone(), "states": self._states.clone()}
        return left if len(self._steps) else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with the initial states that were left."""
        if state:
            self._steps, self._states = state["steps"], state["states"]
