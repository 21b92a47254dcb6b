"""Policies that need no training, beside which a learned policy has to stand: constant and random controls."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.evaluation.monte_carlo import ENTRIES
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator, Step, exit_value

FEW_CONTROLS = 2
"""The number of controls up to which all vertices of their box are candidates."""

MOST_VERTICES = 4
"""The number of random vertices that are candidates where there are more controls."""


class OpenLoop(NamedTuple):
    """What controls reach that do not look at the state.

    Attributes:
        constant: success (N,) of the best constant control, on other paths than those that chose it.
        action: that control (m,), normalised to [-1, 1].
        random: success (N,) of random controls.
    """

    constant: Tensor
    action: Tensor
    random: Tensor


@torch.no_grad()
def play_open_loop(simulator: Simulator, tau: Tensor, x: Tensor, rollouts: int, seed: int) -> OpenLoop:
    """Play constant and random controls from tau (N,) and x (N, n), as many at once as memory allows.

    Args:
        simulator: plays the paths.
        tau: times to go (N,), in s.
        x: states (N, n).
        rollouts: the number of paths of each control from each state; half of them choose the best constant.
        seed: of the noise, and of the random controls and vertices.
    """
    rng = torch.Generator(x.device).manual_seed(seed)
    actions, rollouts = constant_actions(simulator.problem, seed).to(x), 2 * max(1, rollouts // 2)
    paths = max(1, ENTRIES // (x.shape[-1] * simulator.channels))
    parts = max(1, paths // ((len(actions) + 1) * rollouts))
    played = [
        _played(simulator, actions, *states, rollouts, rng)
        for states in zip(tau.split(parts), x.split(parts), strict=True)
    ]
    means = torch.cat(played, -1).cpu()
    best = int(means[:-1, 0].mean(-1).argmax())
    return OpenLoop(means[best, 1], actions[best], means[-1].mean(0))


def _played(simulator: Simulator, actions: Tensor, tau: Tensor, x: Tensor, rollouts: int, rng: torch.Generator):
    """The mean payoffs (K + 1, 2, N) of both halves of the rollouts of K constant actions (K, m) and of random ones."""
    problem, groups = simulator.problem, len(actions) + 1
    steps = simulator.clock.split(tau)[0].clamp(min=1)
    shape = (groups, rollouts, len(x))
    left, now, h = (entry.expand(*shape, *entry.shape[1:]).flatten(0, 2) for entry in (steps, x, tau / steps))
    control = torch.cat([actions, actions[:1]]).repeat_interleave(rollouts * len(x), 0)
    at_random = torch.arange(len(now), device=x.device) >= (groups - 1) * rollouts * len(x)
    payoff, rows = torch.zeros(len(now), dtype=torch.float64, device=x.device), torch.arange(len(now), device=x.device)
    while len(rows):
        drawn = 2 * torch.rand(control[rows].shape, generator=rng, dtype=x.dtype, device=x.device) - 1
        action = torch.where(at_random[rows].unsqueeze(-1), drawn, control[rows])
        step = simulator.step(now, problem.controls.denormalize(action), rng, dt=h[rows])
        left = left - 1
        ended = step.reached | step.failed | (left <= 0)
        if ended.any():
            payoff[rows[ended]] = exit_value(problem, Step(*(entry[ended] for entry in step))).double()
        now, left, rows = step.state[~ended], left[~ended], rows[~ended]
    return payoff.view(groups, 2, rollouts // 2, len(x)).mean(2)


def constant_actions(problem: ReachAvoidProblem, seed: int) -> Tensor:
    """Actions (k, m) in [-1, 1]^m: the centre, and the vertices of the box or, with many controls, some of them."""
    m = problem.controls.dim
    if m <= FEW_CONTROLS:
        vertices = torch.tensor([*product((-1.0, 1.0), repeat=m)])
    else:
        rng = torch.Generator().manual_seed(seed)
        vertices = torch.randint(2, (MOST_VERTICES, m), generator=rng) * 2.0 - 1
    return torch.cat([torch.zeros(1, m), vertices])
