"""Ascent of the Hamiltonian to the best control at a state, at a cost that is linear in the number m of controls.

The Hamiltonian of V is the part of L^u V, Eq. (parabolic_operator), that depends on the control:

    H(u) = f(x, u) . grad V,   plus 1/2 Tr(sigma sigma^T hess V) where sigma depends on u.

V is differentiated once for a state, and each control that is tried costs one evaluation of the physics. The ascent
gives one coordinate of the control after the other its best level while the rest stand still. It finds the maximum over
the levels if H is a sum of functions of one coordinate each, as for a drift that is affine in u and a sigma without u,
where the maximum is a vertex of the box of controls. Unlike steps along a gradient in u, it leaves a local maximum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from pirl_rl.arguments import Policy
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

Objective = Callable[[Tensor], Tensor]
"""Maps actions (N, m), normalised to [-1, 1], to numbers (N,), each of which depends on its own action alone.

Those of `hamiltonian` and `value_ahead` map actions (*, N, m) to numbers (*, N)."""

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
        sigma = problem.diffusion(y, u)
        return along + (sigma * (curvature @ sigma)).sum((-2, -1)) / 2

    return value


def expected_ahead(
    solution: Solution, tau: Tensor, x: Tensor, length: float, channels: Sequence[int] | None = None
) -> Objective:
    """E V (*, N) after one Euler step with the action (*, N, m), by a cubature of degree three, Eq. (cubature).

    The mean over y = x + f h +- sqrt(w h) sigma_k, for w columns of sigma, has the mean and the covariance of the step.
    It is bounded where a second derivative is not: next to a face V may change within one step, and there the learned
    curvature may be of any size and sign. V is continued into A and B, see `continued_value`.

    Args:
        solution: gives V, with its values in A and B, and the problem.
        tau: times to go (N,), in s.
        x: states (N, n).
        length: h in s; it is shortened to tau.
        channels: the columns of sigma, at least one; None takes all of them. The effect of a column that does not
            depend on the action adds the same to all actions, to first order in h.
    """
    problem, h = solution.problem, tau.clamp(max=length)

    def value(action: Tensor) -> Tensor:
        u, shape = problem.controls.denormalize(action), action.shape[:-1]
        y = x.expand(*shape, -1)
        sigma = problem.diffusion(y, u).movedim(-1, 0)
        sigma = sigma if channels is None else torch.stack([sigma[k] for k in channels])
        spread = sigma * (len(sigma) * h).sqrt().unsqueeze(-1)
        ends = y + problem.drift(y, u) * h.unsqueeze(-1) + torch.cat([spread, -spread])
        return continued_value(solution, (tau - h).expand(ends.shape[:-1]), ends).mean(0)

    return value


def continued_value(solution: Solution, tau: Tensor, x: Tensor) -> Tensor:
    """V (*), continued into A and B as an odd function about its value at the face, Eq. (continuation).

    By the reflection principle, the mean of this over the ends of paths without drift that start beside a plane face
    is the mean of V over the paths that stop at the face. Without the continuation the mean would count paths that
    cross a face and return within the step as if they had not crossed it, and so favour noise beside B.

    Args:
        solution: gives V, and the problem.
        tau: times to go (*), in s.
        x: states (*, n).
    """
    problem = solution.problem
    failed, reached = problem.failed(x), problem.reached(x)
    y = x
    if problem.has_avoid_set:
        y = torch.where(failed.unsqueeze(-1), _mirrored(problem.avoid_level, x), y)
    if problem.objective == "reach-avoid":
        y = torch.where(reached.unsqueeze(-1), _mirrored(lambda z: problem.reached_constraints(z).amax(-1), x), y)
    # Networks take one axis of points: stacked critics have an axis of their own before it.
    value = solution.value(tau.flatten(), y.flatten(0, -2)).reshape(tau.shape)
    return torch.where(reached, 2 - value, torch.where(failed, -value, value))


def _mirrored(level: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """The states (*, n), mirrored at the zero of a level, to first order in the level."""
    slope = torch.func.grad(lambda y: level(y).sum())(x)
    return x - 2 * level(x).unsqueeze(-1) * slope / slope.square().sum(-1, keepdim=True).clamp(min=1e-12)


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
        sigma, length = problem.diffusion(x.expand(*shape, -1), u), tau.clamp(max=simulator.dt)
        return ahead + length * (sigma * (curvature @ sigma)).sum((-2, -1)) / 2

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


def ascend(objective: Objective, action: Tensor, levels: Tensor, sweeps: int = 1) -> tuple[Tensor, Tensor]:
    """Ascent over levels, one coordinate of the action or one group of s coordinates after the other.

    Args:
        objective: the function to maximise.
        action: where the ascent starts (N, m).
        levels: the levels (k,) of each coordinate, or the combinations (K, s) of levels of each s coordinates in a row.
        sweeps: how often it passes through all coordinates.

    Returns:
        The action (N, m) that was found, and its objective (N,), which is at least that of the start.
    """
    levels = levels.reshape(len(levels), -1)
    best, size = objective(action), levels.shape[1]
    for _ in range(sweeps):
        for i in range(0, action.shape[-1], size):
            for level in levels.unbind():
                trial = action.clone()
                trial[:, i : i + size] = level
                value = objective(trial)
                better = value > best
                best, action = torch.where(better, value, best), torch.where(better.unsqueeze(-1), trial, action)
    return action, best


def improved(
    objective: Objective,
    action: Tensor,
    levels: Tensor,
    inertia: float = 0.0,
    stride: int = 1,
    tried: Sequence[int] | None = None,
) -> tuple[Tensor, Tensor]:
    """The best level of each coordinate while the others stand still, for all coordinates in one call of the objective.

    If H is a sum of functions of one coordinate each, the best levels together are the maximum over the levels. Where
    they are worse together than the best of them alone, that one alone is taken. Groups of s coordinates take the place
    of coordinates where the levels are combinations of theirs.

    Inertia decides between levels that are nearly as good as each other: from an action to each level, the objective
    loses this share of its range over the levels for each unit of their distance, which is the largest of those of the
    coordinates in a group. Between the two maxima of a function whose minimum lies in the middle, an action then goes
    to one and stays there. Where the objective is affine in a coordinate, the best of two bounds stays the best with
    any inertia below 1/2.

    Args:
        objective: the function to maximise, for actions (*, N, m).
        action: the action (N, m) that is improved.
        levels: the levels (k,) of each coordinate in rising order, bounds included, or the combinations (K, s) of
            levels of each s coordinates in a row.
        inertia: that share, >= 0.
        stride: with a number above 1, which divides k - 1, every such level is tried first, and then those between the
            best of them and its neighbours, of which there are 2 (stride - 1). Only for levels of single coordinates.
        tried: the numbers of the groups that may change, counted from 0; None lets all of them.

    Returns:
        The action (N, m), whose objective is at least that of the given one, and how much each group that may change
        matters (N, g): the range of the objective over the levels that were tried and the given action.
    """
    levels = levels.reshape(len(levels), -1)
    size = levels.shape[1]
    groups = action.shape[-1] // size
    own = torch.eye(groups, dtype=torch.bool, device=action.device).repeat_interleave(size, 1)  # (g, m)
    parts = action.unflatten(-1, (groups, size)).movedim(-2, 0)  # (g, N, s)
    if tried is not None:
        own, parts = (torch.stack([entries[i] for i in tried]) for entries in (own, parts))
    before = objective(action)

    def placed(options: Tensor) -> Tensor:
        """Actions (g, *, N, m), each with an option (g, *, N, s) of its group and the others at the given action."""
        where = own.reshape(len(own), *[1] * (options.ndim - 2), -1)
        return torch.where(where, options.repeat(*[1] * (options.ndim - 1), groups), action)

    options = levels[::stride, None].expand(len(own), -1, len(action), -1)
    values = objective(placed(options))
    index, stakes = _preferred(values, before, options, parts, inertia)
    if stride > 1:
        steps = torch.arange(1, stride, device=action.device)
        beside = torch.cat([-steps, steps]).unsqueeze(-1)
        between = levels[(stride * index.unsqueeze(1) + beside).clamp(0, len(levels) - 1)]
        options = torch.cat([options, between], 1)
        values = torch.cat([values, objective(placed(between))], 1)
        index, stakes = _preferred(values, before, options, parts, inertia)
    top = values.gather(1, index.unsqueeze(1)).squeeze(1)
    best = options.gather(1, index[:, None, :, None].expand(-1, -1, -1, size)).squeeze(1)
    alone, which = top.max(0)
    moved = placed(torch.where((top > before).unsqueeze(-1), best, parts))
    together = torch.where(own.any(0), torch.where(own.unsqueeze(1), moved, 0).sum(0), action)
    single = moved.take_along_dim(which[None, :, None], 0).squeeze(0)
    return torch.where((objective(together) >= alone).unsqueeze(-1), together, single), stakes.mT


def _preferred(values: Tensor, before: Tensor, options: Tensor, parts: Tensor, inertia: float) -> tuple[Tensor, Tensor]:
    """The best option of each group after inertia (groups, N), and the range of the values (groups, N).

    Args:
        values: of the options (groups, k, N).
        before: the value (N,) of the given action.
        options: (groups, k, N, s).
        parts: the coordinates of the given action (groups, N, s).
        inertia: see `improved`.
    """
    stakes = torch.maximum(values.amax(1), before) - torch.minimum(values.amin(1), before)
    distance = (options - parts.unsqueeze(1)).abs().amax(-1)
    return (values - inertia * stakes.unsqueeze(1) * distance).argmax(1), stakes


def replaced(action: Tensor, column: int, level: Tensor | float) -> Tensor:
    """The action (N, m) with one coordinate replaced by a number."""
    changed = action.clone()
    changed[:, column] = level
    return changed
