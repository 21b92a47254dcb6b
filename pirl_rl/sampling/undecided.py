"""Initial states where success is neither certain nor impossible, and where V does not solve its equation."""

from __future__ import annotations

import math
from typing import Any, Protocol

import torch
from torch import Tensor

from pirl_rl.compilation import Compiled
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates
from pirl_rl.simulator import Simulator
from pirl_rl.structure import noise_channels

LARGEST = 2.0
"""The largest residual that counts, in units of V over the horizon: layers at faces have residuals of any size."""

MOST_CHANNELS = 16
"""The largest number of noise channels with which the residual, which has a column for each, is computed."""

FEW_STEPS = 100
"""The largest number of control steps in the horizon with which the residual is compiled, on a CPU.

Then so many episodes end that their starts take a large part of the time. With more steps compilation saves little.
"""


class HasValue(Protocol):
    """Something that knows V and its policy, such as a `pirl_rl.solution.Solution`."""

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (N,) in [0, 1] at times to go tau (N,), in s, and states x (N, n)."""
        ...

    def residual(self, tau: Tensor, x: Tensor) -> Tensor:
        """The HJB residual of V under its policy (N,), in 1/s, at times to go tau (N,), in s, and states x (N, n)."""
        ...


class UndecidedStates:
    """States of another distribution, more often where V is neither near 0 nor near 1, and where it is wrong.

    In many dimensions most of a box is lost or safe whatever the control is, and a path from there teaches little. One
    of `candidates` states is therefore drawn, without replacement, with a weight of
    floor + (1 - floor) 4 V (1 - V) + gain min(T |L^pi V|, 2), where V and its HJB residual, Eq. (parabolic_operator),
    are those of the networks as they stand, at the time to go of the episode, and T is the horizon. Such a draw is
    repeated with the same states as often as it takes for all the states that are needed, because the residual costs
    more than the rest. A state that is drawn several times begins paths with different noise.

    The residual shows where the networks are wrong, before any outcome does. A state may be rare in the box and matter
    all the same, as between two ways past an obstacle that are equally good. Points of a physics-informed network are
    drawn in the same way (C. Wu et al., Computer Methods in Applied Mechanics and Engineering 403, 2023).

    Copies for other processes lose the networks, which would be out of date there, and take the states as they come.

    Args:
        others: the other distribution.
        solution: gives V.
        simulator: its clock turns control steps to go into times to go.
        floor: the weight of a state at which V is 0 or 1, where a state at which V = 1/2 has the weight 1; in (0, 1].
        candidates: the number of states of which a draw takes one, >= 1.
        gain: the factor of the residual, >= 0; 0 leaves it out, and so do more than `MOST_CHANNELS` columns of sigma.
        compile: whether the residual may be compiled, see `FEW_STEPS`.

    Attributes:
        groups: the states are in the order (groups, *), and each group is drawn from its own candidates; 1 except for
            several trainings that play together, each of which has its own V.

    Raises:
        ArgumentError: a number is out of range.
    """

    def __init__(
        self,
        others: InitialStates,
        solution: HasValue,
        simulator: Simulator,
        floor: float = 0.2,
        candidates: int = 4,
        gain: float = 0.0,
        compile: bool = False,
    ):
        if not 0 < floor <= 1 or candidates < 1 or not gain >= 0:
            raise ArgumentError(
                "initial_states: expected 0 < floor <= 1, candidates >= 1 and gain >= 0, "
                f"got {floor}, {candidates} and {gain}"
            )
        self.others, self.clock = others, simulator.clock
        self.floor, self.candidates, self.gain = floor, candidates, gain
        self.take_value_of(solution)
        if compile:
            self._compiled = Compiled(solution.residual, "the residual of V at initial states")

    def take_value_of(self, solution: HasValue, groups: int = 1) -> None:
        """Draw each of several groups of states by the V of this solution, whose residual is not compiled."""
        self.solution, self.groups, self._compiled = solution, groups, None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"solution": None, "_compiled": None}

    def sample(
        self,
        problem: ReachAvoidProblem,
        count: int,
        max_steps: int,
        rng: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        if self.solution is None:
            return self.others.sample(problem, count, max_steps, rng, dtype, visited)
        needed = count // self.groups
        drawn = math.ceil(needed / self.candidates)
        size = self.groups * self.candidates * drawn
        steps, x = self.others.sample(problem, size, max_steps, rng, dtype, visited)
        tau = self.clock.time(steps).to(x)
        # The trainer reports networks that have diverged.
        v = self.solution.value(tau, x).nan_to_num(0.5).clamp(0, 1)
        weight = self.floor + (1 - self.floor) * 4 * v * (1 - v)
        if self.gain and noise_channels(problem) <= MOST_CHANNELS:
            compiled = self._compiled if max_steps <= FEW_STEPS and x.device.type == "cpu" else None
            residual = problem.horizon * (compiled or self.solution.residual)(tau, x).abs()
            weight = weight + self.gain * residual.nan_to_num(0.0).clamp(max=LARGEST)
        draws = math.ceil(needed / drawn)
        weights = weight.reshape(self.groups, -1).repeat_interleave(draws, 0)
        chosen = torch.multinomial(weights, drawn, generator=rng).reshape(self.groups, -1)[:, :needed]
        rows = torch.arange(self.groups, device=x.device).unsqueeze(-1) * (len(x) // self.groups)
        chosen = (chosen + rows).flatten()
        return steps[chosen], x[chosen]
