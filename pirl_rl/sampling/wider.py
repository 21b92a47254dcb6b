"""Initial states beyond the box of states, as far as paths go.

No face need stop a path at the edge of `problem.states`, and the best way to the target may lead out of the box, round
and back. V and the policy are then needed where no episode would start.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.progress import announce
from pirl_rl.sampling.initial_states import InitialStates, mixed
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator

PATHS = 512
"""The number of paths that show how far paths go."""

LOOKS = 50
"""The number of times, evenly over the horizon, at which their states are noted."""

TAIL = 0.02
"""The share of the noted states that may lie beyond the wider box on one side of an axis."""

NAMED = 6
"""The largest number of axes whose wider edges are printed."""

FARTHEST = 2.0
"""The largest coordinate of an edge of the wider box, in coordinates in which `states` is [-1, 1]^n."""


class WiderStates:
    """Some of the states uniform in a box as wide as paths go, the rest from another distribution.

    A state of the wider box that lies in A or B, or is unreachable, is replaced by one of the other distribution.

    Args:
        others: the other distribution, which also gives the steps to go of all episodes.
        simulator: plays the paths that show how far paths go.
        share: the probability of a state from the wider box, in [0, 1].

    Attributes:
        box: the wider box, see `box_of_paths`; None where paths stay in `states` or `share` is 0, and then all states
            are from the other distribution.

    Raises:
        ArgumentError: `share` is out of range.
    """

    common = True

    def __init__(self, others: InitialStates, simulator: Simulator, share: float = 0.5):
        if not 0 <= share <= 1:
            raise ArgumentError(f"initial_states: expected 0 <= share <= 1, got {share}")
        self.others, self.share = others, share
        states = simulator.problem.states
        box = box_of_paths(simulator, others) if share else states
        edges, wider = ([*zip(one.low, one.high, strict=True)] for one in (states, box))
        moved = [axis for axis in range(states.dim) if edges[axis] != wider[axis]]
        self.box = box if moved else None
        if moved:
            named = ["from {:.3g} to {:.3g} along axis {}".format(*wider[axis], axis) for axis in moved[:NAMED]]
            rest = f", and along {len(moved) - NAMED} other axes" if len(moved) > NAMED else ""
            announce(
                f"starts: Paths leave the box of states. Some episodes start in a wider box, {', '.join(named)}{rest}."
            )

    def sample(
        self,
        problem: ReachAvoidProblem,
        count: int,
        max_steps: int,
        rng: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        steps, x = self.others.sample(problem, count, max_steps, rng, dtype, visited)
        if self.box is None:
            return steps, x
        wide = self.box.sample(count, rng, dtype, rng.device)
        return steps, mixed(problem, wide, x, self.share, rng)


def box_of_paths(simulator: Simulator, starts: InitialStates) -> Box:
    """The smallest box that holds `states` and, on each side of each axis, all but `TAIL` of the states of paths.

    The paths have starts from a distribution and the whole horizon to go. Each has one constant control, drawn
    uniformly, and stops in A and B. A periodic axis is not widened, and no edge moves out farther than `FARTHEST`.

    Args:
        simulator: plays the paths.
        starts: the distribution of their starts.
    """
    simulator = replace(simulator, compile=False)
    problem, steps, rng = simulator.problem, simulator.clock.max_steps, torch.Generator().manual_seed(0)
    _, x = starts.sample(problem, PATHS, steps, rng, torch.get_default_dtype())
    u, noted = problem.controls.sample(PATHS, rng, x.dtype), [x]
    for count in range(1, steps + 1):
        step = simulator.step(x, u, rng, crossings=False)  # a path may as well stop a step later
        goes_on = ~(step.reached | step.failed)
        x, u = step.state[goes_on], u[goes_on]
        if not len(x):
            break
        if count % max(1, steps // LOOKS) == 0:
            noted.append(x)
    z = problem.states.normalize(torch.cat(noted)).double().sort(0).values
    tail = round(TAIL * len(z))
    low, high = list(problem.states.low), list(problem.states.high)
    for axis in set(range(problem.states.dim)) - set(problem.states.periodic):
        middle, half = (low[axis] + high[axis]) / 2, (high[axis] - low[axis]) / 2
        below, above = z[tail, axis].item(), z[-1 - tail, axis].item()
        # An edge that does not move keeps every digit.
        low[axis] = low[axis] if below >= -1 else middle + half * max(below, -FARTHEST)
        high[axis] = high[axis] if above <= 1 else middle + half * min(above, FARTHEST)
    return Box(low, high, problem.states.periodic)
