"""The distribution of V after one control step, by a cubature rule for the noise of the step."""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


def values_ahead(solution: Solution, simulator: Simulator, tau: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """V at the 2 w points y +- sqrt(w h) sigma_j after a control step of the length h = min(dt, tau).

    y is the state after the step without noise, and sigma_j is a column of sigma(x, u). The mean of a function over the
    points is its expectation for normal noise, if the function is a polynomial of at most the third degree (A. H.
    Stroud, Mathematical Tables and Other Aids to Computation 11, 1957). The rule needs no derivatives of V, and it sees
    the sets A and B at its points. Exits between the ends of the step are left out.

    Args:
        solution: gives V and the problem.
        simulator: gives the length of a control step and integrates the drift.
        tau: times to go (N,), in s.
        x: states (N, n).
        u: physical controls (N, m), held over the step.

    Returns:
        V (2 w, N) at the points, each of which has the same weight.
    """
    problem, h = solution.problem, tau.clamp(max=simulator.dt)
    sigma = problem.diffusion(x, u)
    kicks = (sigma * (sigma.shape[-1] * h).sqrt()[..., None, None]).movedim(-1, 0)
    middle = simulator.flow(x, u, h)
    points = problem.states.wrap(torch.cat([middle + kicks, middle - kicks]))
    left = (tau - h).expand(points.shape[:-1])
    inside = solution.value(left.flatten(), points.flatten(0, 1)).reshape(left.shape)
    return torch.where(left > 0, inside, problem.boundary_value(points))
