"""Closed-loop paths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pirl_rl.evaluation.monte_carlo import Policy
from pirl_rl.simulator import Simulator


@dataclass(frozen=True)
class Trajectories:
    """Paths in K control steps: `tau` (K + 1, N) and `state` (K + 1, N, n), the latter held after a path's end; `steps`
    (N,) until that end; `reached`, `failed` (N,) bool."""

    tau: Any
    state: Any
    steps: Any
    reached: Any
    failed: Any


@torch.no_grad()
def closed_loop(simulator: Simulator, policy: Policy, tau: Tensor, x: Tensor, rng: torch.Generator) -> Trajectories:
    """Simulate one path from each (tau, x), (N,) and (N, n), until it reaches A or B or its time, rounded to whole
    control steps, is over."""
    problem, left = simulator.problem, torch.round(tau.double() / simulator.dt).long()
    reached, failed, steps = problem.reached(x), problem.failed(x), torch.zeros_like(left)
    times, states = [tau], [x]
    for _ in range(int(left.max())):
        step = simulator.step(x, policy((left * simulator.dt).to(x), x).to(x.dtype), rng)
        active = ~(reached | failed) & (left > 0)
        x = torch.where(active.unsqueeze(-1), step.state, x)
        reached, failed = reached | (active & step.reached), failed | (active & step.failed)
        steps, left = steps + active, (left - 1).clamp(min=0)
        times.append((left * simulator.dt).to(x))
        states.append(x)
    return Trajectories(torch.stack(times), torch.stack(states), steps, reached, failed)
