"""What an action at a state is worth: the functions of the action that an actor or a policy maximises.

The Hamiltonian of V is the part of L^u V, Eq. (parabolic_operator), that depends on the control:

    H(u) = f(x, u) . grad V,   plus 1/2 Tr(sigma sigma^T hess V) where sigma depends on u.

V is differentiated once for a state, and each control that is tried costs one evaluation of the physics. The other
function is V some control steps ahead without noise; `pirl_rl.cubature` has V after one step with noise.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pirl_rl.arguments import Policy
from pirl_rl.ascent import Objective, ascend
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

CHUNK_ENTRIES = 2**26
"""The largest number of entries of sigma, over all points and actions, that are in memory at once."""

Flow = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Maps states (N, n), controls (N, m) and lengths (N,), in s, to the states (N, n) after a step without noise."""


def hamiltonian(solution: Solution, tau: Tensor, x: Tensor, controlled_noise: bool) -> Objective:
    """H (*, N), in 1/s, as a function of normalised actions (*, N, m).

    Args:
        solution: gives V, whose action is frozen at the policy's, and the problem.
        tau: times to go (N,), in s.
        x: states (N, n).
        controlled_noise: whether sigma depends on u, see `pirl_rl.structure.has_controlled_noise`.
    """
    problem, slope = solution.problem, solution.gradient(tau, x)
    curvature = solution.hessian(tau, x) if controlled_noise else None

    def value(action: Tensor) -> Tensor:
        u = problem.controls.denormalize(action)
        y = x.expand(*u.shape[:-1], x.shape[-1])
        along = (problem.drift(y, u) * slope).sum(-1)
        if curvature is None:
            return along
        entries = problem.diffusion(y[..., :1, :], u[..., :1, :]).numel()
        size = max(1, CHUNK_ENTRIES // max(1, entries))
        if size >= len(x):
            return along + _bend(problem, y, u, curvature)
        parts = zip(y.split(size, -2), u.split(size, -2), curvature.split(size), strict=True)
        return along + torch.cat([_bend(problem, *part) for part in parts], -1)

    return value


def _bend(problem: ReachAvoidProblem, x: Tensor, u: Tensor, curvature: Tensor) -> Tensor:
    """1/2 Tr(sigma sigma^T M) (*, N) at states (*, n) and controls (*, m), of M (N, n, n)."""
    sigma = problem.diffusion(x, u)
    return (sigma * (curvature @ sigma)).sum((-2, -1)) / 2


def value_ahead(
    solution: Solution, simulator: Simulator, tau: Tensor, x: Tensor, steps: int, flow: Flow | None = None
) -> Objective:
    """V after a few control steps without noise, the first of them with the action (*, N, m), the others with pi.

    A path stops at the end of the step in which it enters A or B, and at tau = 0. Where sigma depends on the control,
    the expectation of the noise's effect is added to first order: 1/2 Tr(sigma sigma^T hess V) at x times the length
    of the first step.

    Args:
        solution: gives V, pi and the problem.
        simulator: simulates the control steps.
        tau: times to go (N,), in s.
        x: states (N, n).
        steps: the number of control steps, at least 1.
        flow: replaces `simulator.flow`, compiled for example.
    """
    problem, clock, flow = solution.problem, simulator.clock, flow or simulator.flow
    curvature = solution.hessian(tau, x) if simulator.controlled_noise else None

    def value(action: Tensor) -> Tensor:
        u, shape = problem.controls.denormalize(action), action.shape[:-1]
        t, y = tau.expand(shape).flatten(), x.expand(*shape, -1).flatten(0, -2)
        for index in range(steps):
            left, shortfall = clock.split(t)
            live, h = problem.interior(y) & (left > 0), clock.length(left, shortfall).to(y)
            y = torch.where(live.unsqueeze(-1), flow(y, solution.policy(t, y) if index else u.flatten(0, -2), h), y)
            t = torch.where(live, t - h, t).clamp(min=0)
        ahead = solution.value(t, y).reshape(shape)
        if curvature is None:
            return ahead
        return ahead + tau.clamp(max=simulator.dt) * _bend(problem, x.expand(*shape, -1), u, curvature)

    return value


def look_ahead_policy(solution: Solution, simulator: Simulator, steps: int, levels: Tensor) -> Policy:
    """The policy that takes the control with the largest V some control steps ahead, see `value_ahead`.

    Args:
        solution: gives V, and the policy at which the search starts and which it follows after the first step.
        simulator: simulates the control steps.
        steps: the number of control steps, at least 1.
        levels: the candidates (K, s) for s coordinates of the control together, see `ascend`.
    """
    controls = solution.problem.controls

    def policy(tau: Tensor, x: Tensor) -> Tensor:
        start = controls.normalize(solution.policy(tau, x))
        return controls.denormalize(ascend(value_ahead(solution, simulator, tau, x, steps), start, levels.to(x))[0])

    return policy
