"""What a control is worth that is held for a while, where V has a valley between two ways that are equally good.

Before a wall a car must turn to one side or to the other, and V is the larger of the values of the two ways. Where they
are equal V has a kink, which a network rounds off: its gradient points to either side only at some distance from the
bottom of the valley. If the bottom lies in the wrong place, the Hamiltonian hardly moves it. The states beside it take
the worse way, V learns what that way is worth, and the Hamiltonian agrees. A control that is held for a while leads out
of the valley, to where V is known better.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pirl_rl.ascent import Objective
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.rates import fastest_rate, sample_pairs
from pirl_rl.simulator import midpoint_drift
from pirl_rl.solution import Solution

PIECES = 2
"""The number of steps, by the midpoint rule, in which a control is held."""

LONGEST = 8
"""The largest number of control steps for which a control is held.

A control step is at most half as long as a set is thick. A path is looked at in the middle and at the end of each
piece, so that it moves for two control steps between two looks, and does not pass a thin wall unseen.
"""

TURN = 0.5
"""The longest time for which a control is held, times the drift's fastest rate."""


def longest_hold(problem: ReachAvoidProblem, dt: float) -> float:
    """The longest time in s for which a control is held: `LONGEST` control steps, or less where the drift turns fast.

    A control that is best for a time t is best in the middle of this time. With the drift's fastest rate r, see
    `pirl_rl.rates.fastest_rate`, an oscillator turns by the angle r t/2 until then, and so does its best control. With
    r t at most `TURN` this angle is at most a quarter of a radian. Where that is less than a control step, no control
    is held, and the time is 0.

    Args:
        problem: the physics.
        dt: the control step, in s.
    """
    rate = fastest_rate(problem, *sample_pairs(problem))
    longest = min(LONGEST * dt, TURN / rate) if rate > 0 else LONGEST * dt
    return longest if longest >= dt else 0.0


def held_value(solution: Solution, tau: Tensor, x: Tensor, length: float) -> Objective:
    """The larger of V after holding a control and of its tangent (*, N), in 1/s, Eq. (held_value).

    Along the path of a control from x, V may bend upwards, as it does out of a valley. It is then above its tangent,
    and counts itself. Where it bends downwards, as on a ridge between two states that the control must not leave, the
    tangent is the larger one. It is the Hamiltonian, which belongs to a control that is not held. Noise is left out.
    Paths stop in A and B.

    Args:
        solution: gives V, and the problem, whose sigma does not depend on the control.
        tau: times to go (N,), in s.
        x: states (N, n) outside A and B.
        length: the time for which the control is held, in s; it is shortened to tau.

    Returns:
        A function of normalised actions (*, N, m).
    """
    problem, slope = solution.problem, solution.gradient(tau, x)
    duration = tau.clamp(max=length)
    later, h = tau - duration, (duration / PIECES).unsqueeze(-1)
    unmoved = solution.value(later, x)

    def value(action: Tensor) -> Tensor:
        u, y = problem.controls.denormalize(action), x.expand(*action.shape[:-1], -1)
        drift = problem.drift(y, u)
        tangent = (drift * slope).sum(-1)
        for piece in range(PIECES):
            drift = problem.drift(y, u) if piece else drift
            middle = problem.states.wrap(y + drift * (h / 2))
            moved = problem.states.wrap(y + midpoint_drift(problem, y, u, drift, h) * h)
            moved = torch.where(problem.interior(middle).unsqueeze(-1), moved, middle)
            y = torch.where(problem.interior(y).unsqueeze(-1), moved, y)
        # Networks take one axis of points.
        ahead = solution.value(later.expand(y.shape[:-1]).flatten(), y.flatten(0, -2)).reshape(y.shape[:-1])
        return torch.maximum(tangent, (ahead - unmoved) / duration)

    return value
