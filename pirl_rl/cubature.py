"""One step with noise: the expectation of V after an Euler step, by a cubature that minds the faces of A and B.

A step whose noise goes half way to a face at most needs two points for each column of sigma. Nearer to a face the time
at which a path meets it shortens the drift, V is continued across it, and beside B the points reach farther.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.ascent import Objective
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box
from pirl_rl.solution import Solution

TINY = torch.finfo(torch.float32).tiny
"""The smallest square of a slope that counts."""

FAR = 3.0
"""The distance from a face, in sqrt(2 h) times the noise across it, from which paths hardly meet it within h."""

NEAR_B = 3
"""c for one and two columns beside B, the square of the distance of the ends of a cubature in standard deviations."""


class Face(NamedTuple):
    """The level g (N,) of a set that absorbs, with its gradient (N, n), at states (N, n), and whether the set is B."""

    level: Tensor
    slope: Tensor
    fails: bool


def absorbing_faces(problem: ReachAvoidProblem, x: Tensor) -> list[Face]:
    """The levels of A and B, as far as they absorb, at states x (N, n)."""
    levels = [(problem.scaled_avoid_level, True)] if problem.has_avoid_set else []
    if problem.objective == "reach-avoid":
        levels.append((problem.scaled_reached_level, False))
    return [Face(level(x), torch.func.grad(lambda y, level=level: level(y).sum())(x), fails) for level, fails in levels]


def free_step(
    problem: ReachAvoidProblem,
    x: Tensor,
    faces: Sequence[Face],
    channels: Sequence[int],
    shortest: float,
    longest: float,
) -> Tensor:
    """The length (N,) in s, between two bounds, of an Euler step whose noise goes at most half way to A and to B.

    The ends of the cubature of `expected_ahead` are at +- sqrt(w h) sigma_k, except beside B. With s = |sigma^T grad g|
    for the level g of a set, they move g by at most s sqrt(w h) to first order, so that h = g^2 / (4 w s^2). The noise
    is the strongest of several controls: two opposite corners and the center of the box of controls, and the bounds of
    each coordinate with the others in the middle.

    Args:
        problem: the physics.
        x: states (N, n).
        faces: those at x, see `absorbing_faces`.
        channels: the w columns of sigma that count, at least one.
        shortest, longest: the bounds of the length, in s.
    """
    m = problem.controls.dim
    axes = torch.eye(m, dtype=x.dtype, device=x.device)
    corner = axes.new_ones(int(m > 1), m)  # the bounds of a single control are its corners
    actions = torch.cat([axes, -axes, axes.new_zeros(1, m), corner, -corner])
    u = problem.controls.denormalize(actions.unsqueeze(1).expand(-1, len(x), m))
    sigma = problem.diffusion(x.expand(len(u), -1, -1), u)[..., list(channels)].nan_to_num(0.0)
    length = torch.full_like(x[:, 0], longest)
    for level, slope, _ in faces:
        free = level.square() / (4 * len(channels) * _spread(slope, sigma).amax(0)).clamp(min=TINY)
        length = torch.minimum(length, free.nan_to_num(0.0))  # a level without a number may be that of a near face
    return length.clamp(min=shortest)


def _spread(slope: Tensor, sigma: Tensor) -> Tensor:
    """|sigma^T grad g|^2 (*, N) for gradients (N, n) of a level g and sigma (*, N, n, w)."""
    return (slope.unsqueeze(-1) * sigma).sum(-2).square().sum(-1)


def time_to_exit(level: Tensor, approach: Tensor, spread: Tensor, h: Tensor) -> Tensor:
    """The mean time (*, N) until a path meets a face or h has passed, as a share of h, Eq. (exit_share).

    It is that of Brownian motion, or that of the drift alone if this is shorter.

    Args:
        level: g (N,), the distance from the face to first order.
        approach: the speed (*, N) at which the drift lowers g.
        spread: the square (*, N) of the noise of g, per s.
        h: lengths (N,), in s.
    """
    z = (level / (2 * h * spread).clamp(min=TINY).sqrt()).clamp(0, FAR)
    share = torch.erf(z) * (1 + 2 * z.square()) + 2 * z * ((-z.square()).exp() / math.sqrt(math.pi) - z)
    by_drift = level / (approach * h).clamp(min=TINY)
    return torch.minimum(share, by_drift).clamp(0, 1).nan_to_num(1.0)


def expected_ahead(
    solution: Solution,
    tau: Tensor,
    x: Tensor,
    faces: Sequence[Face],
    length: float | Tensor,
    channels: Sequence[int],
) -> Objective:
    """E V (*, N) after one Euler step with the action (*, N, m), by a cubature, Eq. (cubature).

    For w columns of sigma the ends lie at y +- sqrt(c h) sigma_k with y = x + f r h, and have the mean and the
    covariance of a step that ends in A and B. In general c = w. With one or two columns c = `NEAR_B` where the ends
    would then go more than half way to B, and y itself has the weight 1 - w/c: nearer ends would not see how steeply V
    falls beside B.

    The mean is bounded where a second derivative is not: next to a face V may change within one step, and there the
    learned curvature may be of any size and sign. V is continued into A and B, see `continued_value`, which takes care
    of the noise. The drift acts until the path meets a face, for the share r of the step, see `time_to_exit`. Otherwise
    controls beside a face would be chosen for a drift that paths hardly ever feel.

    Args:
        solution: gives V, with its values in A and B, and the problem.
        tau: times to go (N,), in s.
        x: states (N, n).
        faces: those at x, see `absorbing_faces`.
        length: h in s, one number or those of all states (N,); it is shortened to tau.
        channels: the w columns of sigma that count, at least one. The effect of a column that does not depend on the
            action adds the same to all actions, to first order in h, and may be left out.
    """
    problem, h = solution.problem, tau.clamp(max=length)
    w = len(channels)
    beside = w < NEAR_B and any(face.fails for face in faces)

    def value(action: Tensor) -> Tensor:
        u, shape = problem.controls.denormalize(action), action.shape[:-1]
        y = x.expand(*shape, -1)
        drift, diffusion = problem.drift(y, u), problem.diffusion(y, u)
        duration, far = h.expand(shape), torch.full_like(h.expand(shape), w)
        for level, slope, fails in faces:
            spread = _spread(slope, diffusion)
            share = time_to_exit(level, -(slope * drift).sum(-1), spread, h)
            duration = torch.minimum(duration, share * h)
            if fails and beside:
                far = torch.where(level.square() < 4 * NEAR_B * h * spread, NEAR_B, far)
        columns, middle = diffusion.movedim(-1, 0), (y + drift * duration.unsqueeze(-1)).unsqueeze(0)
        moves = torch.stack([columns[k] for k in channels]) * (far * h).sqrt().unsqueeze(-1)
        ends = torch.cat([middle + moves, middle - moves, *([middle] if beside else [])])
        values = continued_value(solution, (tau - h).expand(ends.shape[:-1]), ends)
        outer = values[: 2 * w].sum(0) / (2 * far)
        return outer + (1 - w / far) * values[2 * w] if beside else outer

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
    y = x = problem.states.wrap(x)
    failed, reached = problem.failed(x), problem.reached(x)
    if problem.has_avoid_set:
        y = torch.where(failed.unsqueeze(-1), _mirrored(problem.scaled_avoid_level, x, problem.states), y)
    if problem.objective == "reach-avoid":
        y = torch.where(reached.unsqueeze(-1), _mirrored(problem.scaled_reached_level, x, problem.states), y)
    # Networks take one axis of points: stacked critics have an axis of their own before it.
    value = solution.value(tau.flatten(), y.flatten(0, -2)).reshape(tau.shape)
    return torch.where(reached, 2 - value, torch.where(failed, -value, value))


def _mirrored(level: Callable[[Tensor], Tensor], x: Tensor, states: Box) -> Tensor:
    """The states (*, n), mirrored at the zero of a level, to first order in the level.

    The mirror image lies along the normal of the face in coordinates in which the box of states is [-1, 1]^n.
    """
    half_width = states.center_and_half_width(x)[1]
    slope = torch.func.grad(lambda y: level(y).sum())(x) * half_width
    # Levels may have any unit: only a slope of 0 leaves a state where it is.
    step = level(x).unsqueeze(-1) * slope / slope.square().sum(-1, keepdim=True).clamp(min=TINY)
    return x - 2 * half_width * step
