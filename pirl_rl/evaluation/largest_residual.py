"""The largest L^u V over the box of controls, Eq. (hjb_pde), at a cost that is linear in the number m of controls.

Each control has a few levels, bounds included. If they make few controls in all, every one is tried. Otherwise one
control after the other takes its best level while the rest stand still, until nothing changes. This ascent starts at
the policy's control and at the vertex whose coordinates are the bounds that are better each on its own. It finds the
maximum over the levels if L^u V is a sum of functions of one control each, as for a drift that is affine in u and a
sigma without u, where the maximum is a vertex. Otherwise no change of a single control improves what it finds.

The drift is called about 22 m times for five levels. Where sigma depends on u, so is sigma, with a product of n x n and
n x w matrices at every point.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pirl_rl.problem import has_controlled_noise
from pirl_rl.solution import Solution

EXHAUSTIVE = 25
"""The largest number of controls of which every one is tried."""

SWEEPS = 10
"""How often the ascent passes through all controls at most."""

CHUNK = 2**24
"""The largest number of entries of the second derivatives of V that are in memory at once."""


def largest_residual(solution: Solution, tau: Tensor, x: Tensor, along: Tensor, levels: int) -> Tensor:
    """The maximum of L^u V (N,), in 1/s, over the levels of all controls and the policy's control.

    Args:
        solution: gives V, whose action is frozen at the policy's, and the problem.
        tau: times to go (N,), in s.
        x: states (N, n).
        along: L^pi V (N,) of the policy.
        levels: the number of levels of each control, at least 2.
    """
    problem = solution.problem
    m, axis = problem.controls.dim, torch.linspace(-1, 1, levels).to(tau)
    if levels**m <= EXHAUSTIVE:
        largest = along
        for action in torch.cartesian_prod(*[axis] * m).view(-1, m):
            u = problem.controls.denormalize(action).expand(len(x), -1)
            largest = torch.maximum(largest, solution.residual(tau, x, u))
        return largest
    curved = has_controlled_noise(problem)
    size = CHUNK // problem.states.dim**2 + 1 if curved else len(x)
    parts = zip(tau.split(size), problem.states.wrap(x).split(size), strict=True)
    return along + torch.cat([_largest_gain(solution, *part, axis, curved) for part in parts])


def _largest_gain(solution: Solution, tau: Tensor, x: Tensor, axis: Tensor, curved: bool) -> Tensor:
    """The maximum of L^u V - L^pi V (N,) that the ascent finds on the levels `axis`."""
    box = solution.problem.controls
    action = box.normalize(solution.policy(tau, x))
    gain = _gain(solution, tau, x, curved)
    bounds = [torch.stack([gain(_with(action, i, bound)) for bound in (-1, 1)]) for i in range(box.dim)]
    vertex = torch.stack([pair.argmax(0) for pair in bounds], -1).to(x) * 2 - 1
    return torch.maximum(*(_ascent(gain, start, axis) for start in (action, vertex)))


def _gain(solution: Solution, tau: Tensor, x: Tensor, curved: bool) -> Callable[[Tensor], Tensor]:
    """L^u V - L^pi V (N,) as a function of the action (N, m); the derivatives of V are computed once, for all actions.

    It is the difference of f . grad V, and of 1/2 Tr(sigma^T hess V sigma) if sigma depends on u (`curved`).
    """
    problem, slope = solution.problem, solution.gradient(tau, x)
    curvature = solution.hessian(tau, x) if curved else None

    def hamiltonian(u: Tensor) -> Tensor:
        value = (problem.drift(x, u) * slope).sum(-1)
        if curvature is None:
            return value
        sigma = problem.diffusion(x, u)
        return value + (sigma * (curvature @ sigma)).sum((-2, -1)) / 2

    own = hamiltonian(solution.policy(tau, x))
    return lambda action: hamiltonian(problem.controls.denormalize(action)) - own


def _ascent(gain: Callable[[Tensor], Tensor], action: Tensor, axis: Tensor) -> Tensor:
    """The gain (N,) after ascent from the action (N, m), one coordinate after the other on the levels `axis`."""
    best = gain(action)
    for _ in range(SWEEPS):
        before = best
        for i in range(action.shape[-1]):
            for level in axis:
                trial = _with(action, i, level)
                value = gain(trial)
                better = value > best
                best, action = torch.where(better, value, best), torch.where(better.unsqueeze(-1), trial, action)
        if torch.equal(best, before):
            break
    return best


def _with(action: Tensor, column: int, level: Tensor | float) -> Tensor:
    """The action (N, m) with one coordinate replaced by a number."""
    changed = action.clone()
    changed[:, column] = level
    return changed
