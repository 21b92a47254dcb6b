"""Simulated paths of the closed loop of a policy and a problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pirl_rl.arguments import Policy
from pirl_rl.simulator import Simulator


@dataclass(frozen=True)
class Trajectories:
    """N paths of up to K control steps, as tensors or as numpy arrays.

    Attributes:
        tau: times to go (K + 1, N) in s.
        state: states (K + 1, N, n) in SI units, constant after a path's end.
        steps: number of steps (N,) until a path's end.
        reached: whether a path ended in the target (N,).
        failed: whether a path ended in the avoid set (N,).
    """

    tau: Any
    state: Any
    steps: Any
    reached: Any
    failed: Any


@torch.no_grad()
def closed_loop(simulator: Simulator, policy: Policy, tau: Tensor, x: Tensor, rng: torch.Generator) -> Trajectories:
    """Simulate one path from each start until it reaches A or B, or until its time is over.

    Args:
        simulator: plays the steps.
        policy: maps tau (N,) and x (N, n) to the control (N, m) in SI units.
        tau: times to go (N,) in s; the last control step is shorter where dt does not divide tau.
        x: initial states (N, n) in SI units; the path starts with their periodic coordinates in [low, high).
        rng: draws the noise.
    """
    problem, clock = simulator.problem, simulator.clock
    left, shortfall = clock.split(tau)
    x = problem.states.wrap(x)
    reached, failed, steps = problem.reached(x), problem.failed(x), torch.zeros_like(left)
    times, states = [tau], [x]
    for _ in range(int(left.max())):
        u = policy(clock.time(left, shortfall).to(x), x).to(x.dtype)
        step = simulator.step(x, u, rng, dt=clock.length(left, shortfall).to(x))
        active = ~(reached | failed) & (left > 0)
        x = torch.where(active.unsqueeze(-1), step.state, x)
        reached, failed = reached | (active & step.reached), failed | (active & step.failed)
        steps, left = steps + active, (left - 1).clamp(min=0)
        times.append(clock.time(left, shortfall).to(x))
        states.append(x)
    return Trajectories(torch.stack(times), torch.stack(states), steps, reached, failed)
