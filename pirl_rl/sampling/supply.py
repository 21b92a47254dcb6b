"""Supplies of initial states, which are drawn many at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

STEPS_PER_STATE = 4
"""A `Stock` has one initial state for so many steps of a path; most steps end no episode."""

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


class Stock:
    """Queues of initial states on a device, which are filled before the steps in which their states are taken.

    The host does not know how many states are taken. If more are taken than a queue has, it begins anew. The memory of
    the queues stays where it is, so that a recording of kernels can read it.

    Args:
        groups: the number of queues, each for an equal number of paths in a row.
    """

    def __init__(self, groups: int = 1):
        self.groups, self._left = groups, 0
        self._steps, self._states = torch.empty(groups, 0, dtype=torch.int64), torch.empty(groups, 0, 0)
        self._taken = torch.zeros(groups, 1, dtype=torch.int64)

    def fill(self, steps: int, paths: int, draw: Draw) -> None:
        """Fill the queues for the next steps of all paths."""
        size = paths // self.groups * -(-steps // STEPS_PER_STATE)
        counts, states = draw(self.groups * size)
        counts, states = counts.reshape(self.groups, size), states.reshape(self.groups, size, -1)
        if self._states.shape == states.shape:
            self._steps.copy_(counts)
            self._states.copy_(states)
            self._taken.zero_()
        else:
            self._steps, self._states = counts.contiguous(), states.contiguous()
            self._taken = torch.zeros(self.groups, 1, dtype=torch.int64, device=states.device)
        self._left = steps

    def take(self, ended: Tensor, draw: Draw) -> tuple[Tensor, Tensor]:
        """Control steps to go (N,) and states (N, n), of which paths that have ended, (N,) bool, take theirs.

        `draw` gives new states after the last step for which the queues were filled.
        """
        if self._left == 0:
            self.fill(1, len(ended), draw)
        self._left -= 1
        counted = ended.reshape(self.groups, -1).long().cumsum(-1)
        place = (self._taken + counted - 1) % self._steps.shape[1]
        self._taken += counted[:, -1:]
        states = self._states.gather(1, place.unsqueeze(-1).expand(-1, -1, self._states.shape[-1]))
        return self._steps.gather(1, place).flatten(), states.flatten(0, 1)
