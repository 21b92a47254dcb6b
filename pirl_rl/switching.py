"""How the best control changes with the direction of grad V, and what follows for the choice of controls.

The control that is best at a state maximises the Hamiltonian, p . f(x, u) for p = grad V, and Tr(sigma sigma^T M)/2 for
M = hess V where sigma depends on u. Along a line of directions p and M it changes, in small steps or by jumps. Where
the drift is affine in u it jumps between bounds, in one coordinate after the other, and all controls between are as
good at the moment of the jump. Where it is not, the best control may lie between the bounds, those between an old and a
new one may be worse, and several coordinates may jump at once. A heading of pi is one of -pi, and all others lie
between them. To turn a car, forwards to the left is as good as backwards to the right.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.structure import has_controlled_noise, is_control_affine

LEVELS, FINE_LEVELS = 5, 33
"""The numbers of levels of a control where two, its bounds, do not hold the best one, and where five are too few."""

WINDOW = 0.5
"""How close to the best level others are for a mean of them, of a control whose range is [-1, 1]."""

COARSE = 0.0005
"""What `LEVELS` may lose on average, as a share of the range of the Hamiltonian, before they are too few."""

JOINT = 0.25
"""The share of jumps in several coordinates of the control from which these are chosen together."""

MOST_COMBINATIONS = 125
"""The largest number of combinations of the levels of all coordinates among which a policy chooses."""

CURVATURE = 1.5
"""The curvature of V beside its slope, with states counted in half widths of their box."""

POINTS, TURNS = 128, 129
"""The numbers of states, and of directions p on a line at each of them."""

MARKS = 17
"""The levels of each control that are compared."""

TOGETHER = 2
"""The largest number of coordinates of u that change together; the others are drawn at random."""

FAR = 4
"""The least number of levels in a coordinate that makes a change of the best control a jump."""


class Switching(NamedTuple):
    """How the best control changes.

    Attributes:
        joint: the share of the jumps that change several coordinates of the control at once; 0 where there is no jump.
        coarseness: the mean of what `LEVELS` levels lose against `MARKS`, as a share of the range of the Hamiltonian.
    """

    joint: float
    coarseness: float


def control_levels(problem: ReachAvoidProblem) -> int:
    """The number of levels of each coordinate of the control, bounds included, one of which is nearly the best.

    Where the Hamiltonian is affine in u, it has its maximum at the bounds. Else the maximum may lie between them, and
    few levels may be too coarse, as they are for a heading.
    """
    if is_control_affine(problem):
        return 2
    return FINE_LEVELS if switching(problem).coarseness > COARSE else LEVELS


def actor_choices(problem: ReachAvoidProblem) -> int | None:
    """The number of levels among which an actor chooses for each coordinate of the control, or None for a tanh output.

    An actor chooses where the Hamiltonian is not affine in u, so that it jumps over controls that are worse than those
    on both sides.

    Args:
        problem: the physics.
    """
    levels = control_levels(problem)
    return None if levels == 2 else levels


def choice_window(problem: ReachAvoidProblem, levels: int) -> float:
    """How close to the best of so many levels others are for a mean of them, see `pirl_rl.layers.WindowedChoice`.

    It is 0, and the best level alone is taken, except where sigma depends on u and the best control often lies between
    the bounds. There V is nearly straight where the policy makes strong noise, and bends where it makes weak noise, and
    the best control in turn depends on how V bends. So the best control at a state changes many times in a training. An
    actor that chooses one level ends at one of these controls, and a tanh output at the mean of all. The first is worse
    where the Hamiltonian is concave in u, and the second where it is convex: between two strong noises of opposite
    signs, as of a share that is bought or sold, lies none. The mean of those within a window is good in both cases.

    Args:
        problem: the physics.
        levels: the number of levels of each coordinate.
    """
    return WINDOW if levels == FINE_LEVELS and has_controlled_noise(problem) else 0.0


def coordinates_together(problem: ReachAvoidProblem, levels: int) -> int:
    """The number of coordinates of the control that are chosen together: all of them, or one at a time.

    To turn a car round, forwards to the left becomes backwards to the right. Each half of this change alone is for the
    worse, so that a search in one coordinate does not find it. Whole controls are chosen where many of the jumps are of
    this kind, and the combinations of all levels are few.

    Args:
        problem: the physics.
        levels: the number of levels of each coordinate.
    """
    m = problem.controls.dim
    few = m > 1 and levels**m <= MOST_COMBINATIONS
    return m if few and switching(problem).joint > JOINT else 1


def candidate_controls(problem: ReachAvoidProblem, levels: int | None = None) -> Tensor:
    """Normalised candidates (K, s) for s coordinates of the control together, among which a look ahead chooses.

    Args:
        problem: the physics.
        levels: the number of levels of each coordinate, bounds included, at least 2. None takes that of
            `control_levels`, and at least `LEVELS`, since V ahead is not affine in u.
    """
    levels = max(LEVELS, control_levels(problem)) if levels is None else levels
    together = coordinates_together(problem, levels)
    return torch.cartesian_prod(*[torch.linspace(-1, 1, levels)] * together).reshape(-1, together)


def switching(problem: ReachAvoidProblem, seed: int = 0) -> Switching:
    """How the best control changes along lines of directions, at random states.

    Args:
        problem: the physics.
        seed: of states, controls and directions.
    """
    rng, curved = torch.Generator().manual_seed(seed), has_controlled_noise(problem)
    x = problem.states.sample(POINTS, rng, torch.float64)
    levels, action = _trials(problem.controls.dim, rng)
    y, u = x[:, None].expand(-1, len(levels), -1), problem.controls.denormalize(action)
    one, other = (_hamiltonian(problem, y, u, rng, curved).unsqueeze(1) for _ in range(2))
    score = torch.lerp(one, other, torch.linspace(0, 1, TURNS, dtype=x.dtype).unsqueeze(-1))  # (POINTS, TURNS, K)
    top, best = score.max(-1)

    far = (levels[best[:, 1:]] - levels[best[:, :-1]]).abs() >= FAR
    joint = (far.sum(-1) > 1).sum() / far.any(-1).sum().clamp(min=1)

    few = (levels % ((MARKS - 1) // (LEVELS - 1)) == 0).all(-1)
    spread = (top - score.amin(-1)).mean(1, keepdim=True).clamp(min=1e-12)
    lost = (top - score[..., few].amax(-1)) / spread
    return Switching(joint.item(), lost.mean().item())


def _hamiltonian(problem: ReachAvoidProblem, y: Tensor, u: Tensor, rng: torch.Generator, curved: bool) -> Tensor:
    """The Hamiltonian (N, K) of a random gradient at each of N states y (N, K, n), with controls (N, K, m).

    Where sigma depends on the control, it has the term of a random Hessian with one rise and one fall. States are
    counted in half widths of their box.
    """
    width = problem.states.center_and_half_width(y)[1]
    gradient, up, down = (torch.randn(len(y), 1, y.shape[-1], generator=rng, dtype=y.dtype) for _ in range(3))
    value = (problem.drift(y, u) / width * gradient).sum(-1)
    if curved:
        rows = zip(y, u, up, down, strict=True)  # one state at a time, since sigma may have many entries
        value = value + CURVATURE / 2 * torch.stack([_bend(problem, *row, width) for row in rows])
    return value.nan_to_num(0.0)  # inside a set the physics may have no number, and all controls are alike there


def _bend(problem: ReachAvoidProblem, y: Tensor, u: Tensor, up: Tensor, down: Tensor, width: Tensor) -> Tensor:
    """Tr(sigma sigma^T (up up^T - down down^T)) (K,) at states y (K, n)."""
    sigma = problem.diffusion(y, u) / width.unsqueeze(-1)
    return (up @ sigma).square().sum((-2, -1)) - (down @ sigma).square().sum((-2, -1))


def _trials(m: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """The indices (K, c) of the levels of c coordinates of u, and actions (POINTS, K, m) that have these levels.

    At each point c other coordinates are drawn, and the rest of the action is one random number for each coordinate.
    """
    count = min(TOGETHER, m)
    levels = torch.cartesian_prod(*[torch.arange(MARKS)] * count).reshape(-1, count)
    marks = torch.linspace(-1, 1, MARKS, dtype=torch.float64)[levels]
    moved = torch.stack([torch.randperm(m, generator=rng)[:count] for _ in range(POINTS)]).unsqueeze(1)
    action = 2 * torch.rand(POINTS, 1, m, generator=rng, dtype=marks.dtype) - 1
    trials = action.expand(-1, len(levels), -1)
    return levels, trials.scatter(2, moved.expand(-1, len(levels), -1), marks.expand(POINTS, -1, -1))
