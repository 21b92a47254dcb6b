"""The value a few control steps ahead, along the simulated dynamics."""

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
    """The mean of V after `steps` noise-free control steps, Eq. (look_ahead), over transitions.

    A path stops at the end of the step in which it enters A or B, and at tau = 0, where the last step is shorter if dt
    does not divide tau; V is 1 in A. As dt tends to 0, one step gives the direction of ascent of `Hamiltonian`, if
    sigma does not depend on u.

    Args:
        steps: the number of control steps, at least 1.
        simulator: simulates the steps.

    Raises:
        ArgumentError: `steps` is below 1.
    """

    compiles_whole = False

    def __init__(self, steps: int, simulator: Simulator):
        if steps < 1:
            raise ArgumentError(f"actor_rule.steps: expected at least 1, got {steps}")
        self.steps, self.simulator = steps, simulator
        self.flow: Callable[[Tensor, Tensor, Tensor], Tensor] = simulator.flow

    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        problem, clock = self.simulator.problem, self.simulator.clock
        tau, x = replay["tau"], replay["state"]
        for _ in range(self.steps):
            steps, shortfall = clock.split(tau)
            live, h = problem.interior(x).unsqueeze(-1) & (steps > 0), clock.length(steps, shortfall)
            moved = self.flow(x, problem.controls.denormalize(solution.actor(tau, x)), h.squeeze(-1))
            tau, x = torch.where(live, tau - h.to(tau), tau), torch.where(live, moved, x)
        value = solution.critic(tau, x, solution.actor(tau, x).detach()).mean(0).squeeze(-1)
        return torch.where(problem.reached(x), torch.ones_like(value), value).mean()

    def compile(self, compiler: Callable[[Any], Any]) -> None:
        """Compile the simulator's noise-free step."""
        self.flow = compiler(self.simulator.flow)
