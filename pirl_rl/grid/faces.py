"""V near the faces of A and B, where the noise is weak beside the mesh.

There V rises from a face within a layer that is thinner than a cell, so that interpolation between the nodes is wrong.
By dynamic programming V is the mean of V over paths at the time at which they leave the cells near faces, where paths
that have crossed a face count with its value (Kushner and Dupuis, Numerical Methods for Stochastic Control Problems in
Continuous Time, 2001).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pirl_rl.crossings import crossing_probability
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sigma import times
from pirl_rl.simulator import midpoint_drift
from pirl_rl.structure import noise_channels

PATHS = 512
"""The number of paths from each state."""

STEPS = 32
"""The largest number of steps of a path, at the end of which V between the nodes must do."""

LENGTH = 1.0
"""The largest part of a cell by which the drift moves a path in a step, and the largest deviation of its noise."""

STATES = 2_000
"""The number of states whose paths are held in memory together."""

Function = Callable[[Tensor, Tensor], Tensor]
"""A function of tau (P,) and x (P, n), such as V or a policy."""


def mean_beyond_faces(
    problem: ReachAvoidProblem,
    spacing: Tensor,
    policy: Function,
    value: Function,
    near: Callable[[Tensor], Tensor],
    tau: Tensor,
    x: Tensor,
) -> Tensor:
    """V (P,) at states near faces, outside A and B: its mean over paths at the time at which they leave these cells.

    All states have the same normal numbers, those of a scrambled Sobol sequence, so that V is the same in every call
    and nearly continuous in x. Whether a path crosses a face between the ends of a step is not drawn. The path goes on
    with the probability that it has not, see `pirl_rl.crossings.crossing_probability`. Paths that cross a face of A and
    one of B in the same step count as failures, and so do paths where the physics has no numbers.

    Args:
        problem: the physics.
        spacing: the distances (n,) of the nodes, in SI units.
        policy: gives the controls (P, m), in SI units.
        value: gives V (P,) between the nodes, continued into A and B.
        near: says which of the states (P, n) lie in a cell near a face.
        tau: times to go (P,), in s.
        x: states (P, n), in SI units.
    """
    noises = noise_channels(problem)
    uniform = torch.quasirandom.SobolEngine(STEPS * noises, scramble=True, seed=0).draw(PATHS, dtype=torch.float64)
    normal = torch.special.ndtri(uniform.clamp(1e-9, 1 - 1e-9)).reshape(PATHS, STEPS, noises).to(x)
    means = [
        _mean(problem, spacing, policy, value, near, normal, *part)
        for part in zip(tau.to(x).split(STATES), x.split(STATES), strict=True)
    ]
    return torch.cat(means)


def _mean(
    problem: ReachAvoidProblem,
    spacing: Tensor,
    policy: Function,
    value: Function,
    near: Callable[[Tensor], Tensor],
    normal: Tensor,
    tau: Tensor,
    x: Tensor,
) -> Tensor:
    """`mean_beyond_faces` of a few states, with the normal numbers (paths, steps, w) of the noise."""
    paths = len(normal)
    left, at = tau.repeat_interleave(paths), x.repeat_interleave(paths, 0)
    alive, result = torch.ones_like(left), torch.zeros_like(left)
    going = torch.arange(len(left), device=x.device)
    for step in range(normal.shape[1]):
        moved, h, reached, failed = _step(problem, spacing, policy, left[going], at[going], normal[going % paths, step])
        at[going], left[going] = moved, left[going] - h
        result[going] += alive[going] * reached
        alive[going] *= (1 - reached - failed).clamp(min=0)
        going = going[near(moved) & (alive[going] > 0) & (left[going] > 0)]
        if not len(going):
            break
    under_way = alive > 0
    result[under_way] += alive[under_way] * value(left[under_way], at[under_way])
    return result.reshape(len(x), paths).mean(-1)


@torch.no_grad()
def _step(problem: ReachAvoidProblem, spacing: Tensor, policy: Function, tau: Tensor, x: Tensor, normal: Tensor):
    """Where paths from x (P, n) are after a step with the noise (P, w), its length (P,) in s, and the probabilities,
    each (P,), that they have crossed into A or B on the way."""
    u = policy(tau, x)
    drift, sigma = problem.drift(x, u), problem.diffusion(x, u)
    variance = (sigma / spacing.unsqueeze(-1)).square().sum(-1)
    rate = torch.maximum((drift / spacing).abs() / LENGTH, variance / LENGTH**2).amax(-1)
    h = torch.minimum(tau, 1 / rate.clamp(min=1e-12))
    middle = midpoint_drift(problem, x, u, drift, h.unsqueeze(-1))
    moved = x + middle * h.unsqueeze(-1) + times(sigma, normal) * h.sqrt().unsqueeze(-1)
    lost = ~moved.isfinite().all(-1)
    moved, h = torch.where(lost.unsqueeze(-1), x, problem.states.wrap(moved)), h.masked_fill(lost, 0.0)
    reached, failed = torch.zeros_like(h), torch.zeros_like(h)
    path, within = (x, moved, sigma, h), problem.states.within_period
    if problem.has_avoid_set:
        # One constraint of B suffices, and all of A must hold. The noise of different faces is taken as independent.
        crossed = crossing_probability(within(problem.avoid_constraints), *path, "nearest")
        failed = 1 - (1 - crossed).prod(-1)
    if problem.objective == "reach-avoid":
        crossed = crossing_probability(within(problem.reached_constraints), *path, "farthest")
        reached = (1 - failed) * crossed.prod(-1)
    return moved, h, reached.masked_fill(lost, 0.0), failed.masked_fill(lost, 1.0)
