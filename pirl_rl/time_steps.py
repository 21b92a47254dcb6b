"""Control interval and integration steps, chosen from a problem's own rates and from what holding a control costs.

A control is held during a control step, so that in one step a path should neither cross much of the box of states nor
pass through a set, nor should the noise carry it far across a surface where the best control jumps. The control step is
the longest for which the moves of drift and noise (`pirl_rl.rates`) and the success that holding the control costs are
below the bounds that stand here. Up to two states this success is measured on a grid, see `pirl_rl.grid.held`. Within a
control step the drift is integrated in sub-steps. They resolve its fastest rate, and they are halved until a control
step without noise is that of ten times as many.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError, ProblemError
from pirl_rl.grid.coarse import NODES, coarse_solution
from pirl_rl.grid.held import loss_of_holding
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.rates import Move, across_box, across_sets, control_rate, fastest_rate, sample_pairs
from pirl_rl.simulator import Crossing, Simulator
from pirl_rl.structure import has_controlled_noise

SHARES = {"the box": (0.05, 0.1), "the target": (0.5, 0.5), "the avoid set": (0.5, 0.5)}
"""The largest moves of drift and noise in one control step, in widths of the box and depths of the sets."""

STEPS = (400, 500, 600, 800)
"""The numbers of control steps in the horizon from which one is taken where moves across box and sets limit it."""

LOST = 2e-3
"""The largest mean success lost by holding the control that is accepted."""

LEAST_SHARE = 0.6
"""A cautious estimate of the success lost, in units of `control_rate` times control step and horizon.

On three problems whose noise does not depend on the control a grid shows 0.7, 0.9 and 5.8 of them, see docs/recipe.md.
"""

SHORT_STEPS = (800, 1_600)
"""The numbers of control steps in the horizon from which one is taken where holding the control limits it."""

TOLERANCE = 1e-3
"""The largest error of a control step without noise, in widths of the box, that is accepted."""

COVERED = 0.95
"""The share of the sampled states at which the error is below the tolerance."""

LEAST_STEPS, MOST_SUBSTEPS = 1_600, 256
"""A control step has 2 integration steps at least, up to fewer control steps than the first number, and then 1.

Longer integration steps bias V near corners of the sets. The second number is the largest one that is proposed.
"""


class TimeSteps(NamedTuple):
    """A choice of time steps.

    Attributes:
        dt: the length of a control step, in s.
        substeps: the number of integration steps in a control step.
        moves: the rates of paths across the box and, if they are found, the sets.
        error: how far ten times as many sub-steps change a control step without noise, in widths of the box.
        reason: the choice and the measured numbers behind it, in whole sentences.
    """

    dt: float
    substeps: int
    moves: list[Move]
    error: float
    reason: str


def propose_time_steps(
    problem: ReachAvoidProblem,
    dt: float | None = None,
    substeps: int | None = None,
    samples: int = 1024,
    seed: int = 0,
    crossing: Crossing = "bridge",
    holding: bool = True,
) -> TimeSteps:
    """Choose the control step, which then divides the horizon, and the integration steps of a problem.

    Args:
        problem: the physics.
        dt: a control step in s that is given, so that the sub-steps alone are chosen.
        substeps: a number of sub-steps that is given, so that the control step alone is chosen.
        samples: the number of states in the box, and of controls, half of them vertices, at which rates are measured.
        seed: of the samples.
        crossing: the rule of the simulator, which names the drift of an integration step.
        holding: whether what holding the control costs limits the control step. Its measurement takes seconds.

    Raises:
        ArgumentError: `dt`, `substeps` or `samples` is out of range, or `crossing` is unknown.
    """
    if samples < 1:
        raise ArgumentError(f"samples: expected at least 1, got {samples}")
    check_time_steps(problem, dt, substeps, crossing)
    x, u = sample_pairs(problem, samples, seed)
    moves, rate = [across_box(problem, x, u), *across_sets(problem, x, u)], fastest_rate(problem, x, u)
    if dt is None:
        steps, limit = _steps_of_moves(problem.horizon, moves)
        longest = problem.horizon / steps
        lost = 0.0
        if holding:
            lost = _lost(problem, longest, _substeps(problem, longest, crossing, rate, x, u), x, u)
        if lost > LOST:
            steps = next((short for short in SHORT_STEPS if lost * steps <= LOST * short), SHORT_STEPS[-1])
            limit = f"Holding the control for {longest:.4g} s costs about {lost:.1g} of success."
        chosen = problem.horizon / steps
    else:
        chosen, limit = dt, ""
    count = _substeps(problem, chosen, crossing, rate, x, u) if substeps is None else substeps
    error = _error(problem, chosen, count, crossing, x, u)
    plural = "s" if count > 1 else ""
    sentences = (
        f"Control step {chosen:.4g} s, {problem.horizon / chosen:.4g} in the horizon, with {count} integration "
        f"step{plural}.",
        limit,
        f"In a control step drift and noise move a path by {_parts(moves, chosen)}; the drift's fastest rate is "
        f"{rate:.3g} 1/s; ten times as many integration steps change it by {error:.1g} of the box.",
    )
    return TimeSteps(chosen, count, moves, error, " ".join(filter(None, sentences)))


def check_time_steps(
    problem: ReachAvoidProblem, dt: float | None, substeps: int | None, crossing: Crossing = "bridge"
) -> None:
    """Refuse time steps that are out of range; None is a step that is still to be chosen.

    Raises:
        ArgumentError: `dt` is not in (0, horizon], `substeps` is below 1, or `crossing` is unknown.
    """
    Simulator(problem, problem.horizon if dt is None else dt, 1 if substeps is None else substeps, crossing)


def _longest(move: Move) -> float:
    """The longest control step, in s, in which drift and noise each move by at most their share."""
    drift, noise = SHARES[move.across]
    by_drift = drift / move.speed if move.speed > 0 else float("inf")
    return min(by_drift, (noise / move.spread) ** 2) if move.spread > 0 else by_drift


def _steps_of_moves(horizon: float, moves: list[Move]) -> tuple[int, str]:
    """The smallest number of control steps that the moves allow, and what limits it."""
    slowest = min(moves, key=_longest)
    wanted, across = _longest(slowest), slowest.across
    steps = next((steps for steps in STEPS if horizon / steps <= wanted), STEPS[-1])
    if steps == STEPS[0]:
        return steps, ""
    if horizon / steps <= wanted:
        return steps, f"Moves across {across} limit the control step."
    return steps, f"Moves across {across} ask for {wanted:.2g} s, but more than {STEPS[-1]} steps are not proposed."


def _lost(problem: ReachAvoidProblem, dt: float, substeps: int, x: Tensor, u: Tensor) -> float:
    """The mean success that is lost by holding controls for dt, to which it is proportional, and 0 where it is unknown.

    It is measured on a grid. Noise that depends on the control has a part in it that a grid does not show: then it is
    estimated by the `control_rate` at the states x (N, n) and controls u (N, m). With more than two states it does not
    limit the control step, see docs/recipe.md.
    """
    if problem.states.dim not in NODES:
        return 0.0
    if has_controlled_noise(problem):
        return LEAST_SHARE * control_rate(problem, x, u) * dt * problem.horizon
    solution = coarse_solution(problem)
    try:
        return 0.0 if solution is None else loss_of_holding(solution, dt, max(1, substeps // 2)).mean
    except ProblemError:  # There is no state outside A and B in the box.
        return 0.0


def _substeps(problem: ReachAvoidProblem, dt: float, crossing: Crossing, rate: float, x: Tensor, u: Tensor) -> int:
    """The smallest power of two that resolves the fastest rate and whose error is accepted."""
    count = 1 if problem.horizon >= LEAST_STEPS * dt * (1 - 1e-9) else 2
    while count < min(dt * rate, MOST_SUBSTEPS):
        count *= 2
    while count < MOST_SUBSTEPS and not _error(problem, dt, count, crossing, x, u) <= TOLERANCE:
        count *= 2
    return count


def _error(problem: ReachAvoidProblem, dt: float, substeps: int, crossing: Crossing, x: Tensor, u: Tensor) -> float:
    """How far ten times as many sub-steps change a control step without noise, in widths of the box."""
    coarse, fine = (Simulator(problem, dt, count, crossing).flow(x, u) for count in (substeps, 10 * substeps))
    gap = (coarse - fine).abs() / (2 * problem.states.center_and_half_width(x)[1])
    errors = gap.amax(-1).nan_to_num(torch.inf).sort().values
    return errors[int(COVERED * (len(errors) - 1))].item()


def _parts(moves: list[Move], dt: float) -> str:
    """The moves of drift and noise in one control step, across the box and the fastest constraint of each set."""
    names = dict.fromkeys(move.across for move in moves)
    fastest = [min((move for move in moves if move.across == name), key=_longest) for name in names]
    return ", ".join(f"{move.speed * dt:.2g} and {move.spread * dt**0.5:.2g} of {move.across}" for move in fastest)
