"""The value some control steps ahead along the model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.actor_rules.base import ActorRule
from pirl_rl.errors import ArgumentError
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class LookAhead(ActorRule):
    """The mean of V at the end of a number of noise-free control steps, or at the step that meets A or B.

    It is what the Hamiltonian becomes where a control is held for a whole control step.

    Args:
        steps: control steps to look ahead, at least 1.
        simulator: plays them.

    Raises:
        ArgumentError: fewer than one step.
    """

    compiles_whole = False

    def __init__(self, steps: int, simulator: Simulator):
        if steps < 1:
            raise ArgumentError(f"actor_rule.steps: expected at least 1, got {steps}")
        self.steps, self.simulator = steps, simulator
        self.flow: Callable[[Tensor, Tensor], Tensor] = simulator.flow

    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        problem, dt = self.simulator.problem, self.simulator.dt
        tau, x = replay["tau"], replay["state"]
        for _ in range(self.steps):
            # Half a step of tolerance: tau is a whole number of steps up to rounding.
            live = problem.interior(x).unsqueeze(-1) & (tau > dt / 2)
            moved = self.flow(x, problem.controls.denormalize(solution.actor(tau, x)))
            tau, x = torch.where(live, tau - dt, tau), torch.where(live, moved, x)
        value = solution.critic(tau, x, solution.actor(tau, x).detach()).mean(0).squeeze(-1)
        return torch.where(problem.reached(x), torch.ones_like(value), value).mean()

    def compile(self, compiler: Callable[[Any], Any]) -> None:
        """Compile the simulator's noise-free step."""
        self.flow = compiler(self.simulator.flow)
