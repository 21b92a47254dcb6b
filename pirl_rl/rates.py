"""The rates of a problem, measured at sampled states and controls: across its box and sets, of drift and of control.

Across a length L the drift f moves a path by |f| t in a time t, and the noise by |sigma| sqrt(t). For a coordinate, L
is the width of the box. For a constraint g of A or B, which is -D where the set is deepest, the drift gives
|grad g . f| t, the noise |sigma^T grad g| sqrt(t), and L is D. Where descent alone finds the set, they are taken half
way between its face and its deepest points, where a smooth level has no slope. Inside a set the physics may have no
number: then the rates are those of the states next to it. All rates are medians over the samples: the corners of a box
may have rates that no path meets.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.descent import bisected, descended_parts, starts_of_a_part
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.structure import AbsorbingSet, absorbing_sets

STARTS = 64
"""The number of states of lowest level from which the descent to deep points of a part of a set starts."""

DIFFERENCE = 1e-6
"""Half the step of the differences in the drift's Jacobian, in half widths of the box."""

JACOBIANS = 256
"""The number of states at which the Jacobian is taken."""

CONTROLS = 16
"""The number of controls over which the range of the drift is taken at each state."""


def sample_pairs(problem: ReachAvoidProblem, count: int = 1024, seed: int = 0) -> tuple[Tensor, Tensor]:
    """States outside A and B, or of all the box if none are found, and as many controls, half of them vertices.

    Args:
        problem: the physics.
        count: the number of states that are drawn in the box.
        seed: of the draws.

    Returns:
        States (N, n), of which there are at most `count`, and physical controls (N, m), both in double precision.
    """
    rng = torch.Generator().manual_seed(seed)
    x = problem.states.sample(count, rng, dtype=torch.float64)
    outside = problem.interior(x)
    x = x[outside] if outside.any() else x
    action = 2 * torch.rand(len(x), problem.controls.dim, generator=rng, dtype=x.dtype) - 1
    action[::2] = action[::2].sign()
    return x, problem.controls.denormalize(action)


class Move(NamedTuple):
    """The rates of paths across something.

    Attributes:
        across: what is crossed, for messages.
        speed: of the drift, in 1/s.
        spread: of the noise, in 1/sqrt(s).
    """

    across: str
    speed: float
    spread: float


def across_box(problem: ReachAvoidProblem, x: Tensor, u: Tensor) -> Move:
    """The rates along the fastest coordinate, in widths of the box.

    Args:
        problem: the physics.
        x: states (N, n).
        u: physical controls (N, m).
    """
    width = 2 * problem.states.center_and_half_width(x)[1]
    speed = (problem.drift(x, u).abs() / width).amax(-1)
    spread = (problem.diffusion(x, u).norm(dim=-1) / width).amax(-1)
    return Move("the box", speed.nanmedian().item(), spread.nanmedian().item())


def across_sets(problem: ReachAvoidProblem, x: Tensor, u: Tensor) -> list[Move]:
    """The rates across all constraints of A and B, in depths; a set in which no point is found has none.

    Args:
        problem: the physics.
        x: states (N, n), from which the sets are searched too.
        u: physical controls (N, m).
    """
    return [move for one in absorbing_sets(problem) for move in _across(problem, one, x, u)]


def fastest_rate(problem: ReachAvoidProblem, x: Tensor, u: Tensor) -> float:
    """The largest modulus of an eigenvalue of the drift's Jacobian, in 1/s, at x (N, n) and u (N, m)."""
    x, u = x[:JACOBIANS], u[:JACOBIANS]
    # By central differences, because a drift has to be differentiable for nothing else.
    steps = torch.diag(DIFFERENCE * problem.states.center_and_half_width(x)[1])
    f, wrap = problem.drift, problem.states.wrap
    columns = [(f(wrap(x + h), u) - f(wrap(x - h), u)) / (2 * h.sum()) for h in steps]
    jacobian = torch.stack(columns, -1)
    finite = jacobian.isfinite().flatten(1).all(-1)
    return torch.linalg.eigvals(jacobian[finite]).abs().amax(-1).median().item() if finite.any() else float("nan")


def control_rate(problem: ReachAvoidProblem, x: Tensor, u: Tensor) -> float:
    """How fast the noise makes a held control wrong, in 1/s^2: a s^2, the largest over the coordinates of the state.

    Here a is half the range of the drift over the controls and s the noise, in widths of the box per s and per sqrt(s).
    Beside a surface where the best control jumps, the noise carries a path by s sqrt(dt) across it while the control is
    held for dt. The path is there for a share of the time that is proportional to s sqrt(dt), and V loses there at a
    rate that is proportional to a s sqrt(dt), since the gradient of V along the control is 0 at the surface. So holding
    the control for dt costs success in proportion to a s^2 dt times the horizon.

    Args:
        problem: the physics.
        x: states (N, n).
        u: physical controls (N, m).
    """
    width = 2 * problem.states.center_and_half_width(x)[1]
    controls = [u.roll(shift, 0) for shift in range(min(CONTROLS, len(u)))]
    drift = torch.stack([problem.drift(x, held) for held in controls]) / width
    noise = torch.stack([problem.diffusion(x, held).square().sum(-1) for held in controls]).mean(0) / width**2
    reach = (drift.amax(0) - drift.amin(0)) / 2
    return (reach * noise).amax(-1).nanmedian().item()


class SearchedPart(NamedTuple):
    """What is known about a part of a set.

    Attributes:
        constraints: its levels at any states, (*, n) to (*, k).
        here: their values at the sampled states, (N, k).
        starts, ends: states (K, n) from which the levels were descended, and those to which descent led.
    """

    constraints: Callable[[Tensor], Tensor]
    here: Tensor
    starts: Tensor
    ends: Tensor

    def contains(self, x: Tensor) -> Tensor:
        """Whether states (*, n) lie in the part, (*)."""
        return (self.constraints(x) <= 0).all(-1)


def _across(problem: ReachAvoidProblem, absorbing: AbsorbingSet, x: Tensor, u: Tensor) -> list[Move]:
    """The rates across each level of each part of a set at controls u (N, m), from the states x (N, n)."""
    levels, parts = absorbing.levels, absorbing.parts
    here, count = levels(x), starts_of_a_part(STARTS, len(parts))
    lowest = torch.stack([x[here[:, part].amax(-1).argsort()[:count]] for part in parts])
    deep, rates = descended_parts(levels, parts, lowest, problem.states), []
    for part, starts, ends in zip(parts, lowest, deep, strict=True):
        # The levels at all states are known: a union may have hundreds of parts, which need not compute them again.
        known = SearchedPart(lambda x, part=part: levels(x)[..., part], here[:, part], starts, ends)
        rates += _across_part(problem, known, x, u)
    return [Move(f"the {absorbing.name}", speed, spread) for speed, spread in rates]


def _across_part(problem: ReachAvoidProblem, part: SearchedPart, x: Tensor, u: Tensor) -> list[tuple[float, float]]:
    """The speed and the spread, in depths, across each constraint of a part of a set.

    They are taken with the controls u (M, m), at those of the states x (N, n) that lie in the part, and half way
    between its face and the ends of the descents. Where the physics has no number inside the part, they are those of
    states beside it.
    """
    inside, deep = (part.here <= 0).all(-1), part.contains(part.ends)
    found = torch.cat([part.here[inside], part.constraints(part.ends[deep])])
    if not len(found):
        return []
    depths = (-found).amax(0).tolist()
    entering = deep & ~part.contains(part.starts)
    face = bisected(part.contains, part.ends[entering], part.starts[entering])
    rates = _speeds(problem, part.constraints, torch.cat([x[inside], (face + part.ends[entering]) / 2]), u)
    if rates.isnan().any() and not inside.all():
        beside = x[~inside][part.here[~inside].amax(-1).argsort()[:STARTS]]
        rates = torch.where(rates.isnan(), _speeds(problem, part.constraints, beside, u), rates)
    pairs = zip(depths, *rates.tolist(), strict=True)
    return [(v / depth, s / depth) for depth, v, s in pairs if depth > 0]


def _speeds(problem: ReachAvoidProblem, constraints: Callable[[Tensor], Tensor], x: Tensor, u: Tensor) -> Tensor:
    """The medians, over states (N, n) and controls (M, m), of the speed and of the noise of k levels, (2, k)."""
    u = u[torch.arange(len(x)) % len(u)]
    f, sigma = problem.drift(x, u), problem.diffusion(x, u)
    speed = torch.func.jvp(constraints, (x,), (f,))[1].abs()
    columns = [torch.func.jvp(constraints, (x,), (column,))[1] for column in sigma.unbind(-1)]
    return torch.stack([speed, torch.stack(columns).norm(dim=0)]).nanmedian(1).values
