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

import torch
from torch import Tensor

from pirl_rl.action_values import hamiltonian
from pirl_rl.ascent import ascend, replaced
from pirl_rl.solution import Solution
from pirl_rl.structure import has_controlled_noise

EXHAUSTIVE = 25
"""The largest number of controls of which every one is tried."""

SWEEPS = 3
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
    action = solution.problem.controls.normalize(solution.policy(tau, x))
    objective = hamiltonian(solution, tau, x, curved)
    bounds = [
        torch.stack([objective(replaced(action, i, bound)) for bound in (-1.0, 1.0)]) for i in range(action.shape[-1])
    ]
    vertex = torch.stack([pair.argmax(0) for pair in bounds], -1).to(x) * 2 - 1
    best = torch.maximum(*(ascend(objective, start, axis, SWEEPS)[1] for start in (action, vertex)))
    return best - objective(action)
