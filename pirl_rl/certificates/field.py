"""V of the networks and its residual, as smooth functions of time to go and state in double precision."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.operators import generator, require_twice_differentiable
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.solution import CHUNK_ENTRIES, Solution

POINTS = 256
"""The number of states and controls at which the noise is looked at."""

RANK = 1e-9
"""A singular value of sigma counts as zero if it is smaller than this share of the largest one."""

NEAR = 2.0
"""Whether the equation holds outside the box of states is looked up in a box of this many times the widths."""


class Field(NamedTuple):
    """A problem, V and L^pi V; the functions map tau (N,) in s and x (N, n) in SI units, in float64, to (N,)."""

    problem: ReachAvoidProblem
    value: Callable[[Tensor, Tensor], Tensor]
    residual: Callable[[Tensor, Tensor], Tensor]


def field_of(solution: Solution) -> Field:
    """V(tau, x), the mean of the critics at u = pi(tau, x), and its residual, from copies of the networks on the CPU.

    For critics Q(tau, x, u), the derivatives of V include those of the policy, unlike `Solution.residual`.

    Raises:
        ArgumentError: the solution has no networks.
    """
    if not isinstance(solution, Solution):
        raise ArgumentError(f"corollary: expected the networks of a run, got a {type(solution).__name__}")
    problem = solution.problem
    actor, critic = copy.deepcopy(solution.actor), copy.deepcopy(solution.critic)
    for network in (actor, critic):
        network.cpu().double().requires_grad_(False)

    def value(tau: Tensor, x: Tensor) -> Tensor:
        return critic.at(actor(tau.unsqueeze(-1), x))(tau, x).mean(0)

    def along(tau: Tensor, x: Tensor) -> Tensor:
        action = actor(tau.unsqueeze(-1), x)
        u = problem.controls.denormalize(action)
        if critic.action_input:
            return generator(value, problem, tau, x, u)
        return generator(critic.at(action), problem, tau, x, u).mean(0)

    def residual(tau: Tensor, x: Tensor) -> Tensor:
        entries = problem.diffusion(x[:1], problem.controls.denormalize(actor(tau[:1, None], x[:1]))).numel()
        size = max(1, CHUNK_ENTRIES // max(1, entries))
        return torch.cat([along(*part) for part in zip(tau.split(size), x.split(size), strict=True)])

    return Field(problem, value, residual)


def unmet_assumptions(solution: Solution, rng: torch.Generator) -> list[str]:
    """The assumptions of Corollary 1 that the problem or the networks do not meet, as far as it can be seen."""
    problem, found = solution.problem, []
    x = problem.states.expand(NEAR).sample(POINTS * POINTS, rng, torch.float64)
    sigma = problem.diffusion(x[:POINTS], problem.controls.sample(POINTS, rng, torch.float64))
    _, half_width = problem.states.center_and_half_width(x)
    strengths = torch.linalg.svdvals(sigma / half_width.unsqueeze(-1))
    if problem.payoff.epsilon == 0 or problem.objective == "invariance":
        found.append("continuous data, which jump where a face meets tau = 0")
    if sigma.shape[-1] < sigma.shape[-2] or bool((strengths[:, -1] < RANK * strengths[:, 0]).any()):
        found.append("noise in every direction")
    outside = problem.interior(x) & ~problem.unreachable(x) & ~problem.states.contains(x)
    if bool(outside.any()):
        found.append("a bounded domain that was sampled, while paths may leave the box of states")
    if solution.critic.action_input:
        try:
            require_twice_differentiable(solution.actor.layers)
        except ArgumentError:
            found.append("a smooth V, while the activations of the actor have kinks")
    return found
