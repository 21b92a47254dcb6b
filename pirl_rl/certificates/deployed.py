"""A policy as it is deployed: frozen networks, a simulator with its control interval, and a law of starts."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from pirl_rl.checkpoint import digest
from pirl_rl.evaluation.inputs import like, noise_rng, points_rng
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.problem import with_indicator
from pirl_rl.sampling.initial_states import InitialStates
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

SEEDS = 500_009
"""An offset that separates the seeds of certificates from those of evaluators, by which a run may have been chosen."""


class Rngs(NamedTuple):
    """Independent random generators, of starts and of noise."""

    starts: torch.Generator
    noise: torch.Generator

    @classmethod
    def of(cls, solution: Solution, seed: int) -> Rngs:
        return cls(points_rng(SEEDS + seed), noise_rng(solution, SEEDS + seed))


class Starts(Protocol):
    """Where the paths of a certificate start."""

    def draw(self, deployed: Deployed, count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        """Independent times to go (count,) in s and states (count, n) in SI units."""
        ...

    def describe(self) -> str:
        """The starts in words, to follow the word `from`."""
        ...


@dataclass(frozen=True)
class OneStart:
    """The same start for all paths.

    Args:
        tau: the time to go in s.
        x: the state, n numbers in SI units.
    """

    tau: float
    x: tuple[float, ...]

    def draw(self, deployed: Deployed, count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        state = torch.tensor(self.x, dtype=torch.float64)
        return torch.full((count,), self.tau, dtype=torch.float64), state.expand(count, -1)

    def describe(self) -> str:
        return f"the state {[*self.x]} with {self.tau:g} s to go"


@dataclass(frozen=True)
class LawOfStarts:
    """Independent draws of a distribution.

    Args:
        initial_states: the distribution of states and of control steps to go.
        tau: a time to go in s for all of them, in place of that of the distribution.
    """

    initial_states: InitialStates
    tau: float | None = None

    def draw(self, deployed: Deployed, count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        clock = deployed.simulator.clock
        steps, x = self.initial_states.sample(deployed.solution.problem, count, clock.max_steps, rng, torch.float64)
        tau = clock.time(steps) if self.tau is None else torch.full((count,), self.tau)
        return tau.double(), x

    def describe(self) -> str:
        time = "" if self.tau is None else f" with {self.tau:g} s to go"
        return f"starts drawn by {type(self.initial_states).__name__}{time}"


class Deployed:
    """A frozen policy in a simulator, whose paths succeed or fail: the payoff is the indicator, whatever it was.

    Args:
        solution: the problem, the policy and V.
        simulator: gives the control interval, the sub-steps and the rule of exits.
    """

    def __init__(self, solution: Solution, simulator: Simulator):
        self.solution = solution
        self.simulator = dataclasses.replace(simulator, problem=with_indicator(solution.problem))

    def successes(self, tau: Tensor, x: Tensor, rollouts: int, rng: torch.Generator) -> np.ndarray:
        """The numbers of successes (N,) out of so many independent paths from each start, tau (N,) and x (N, n)."""
        tau, x = like(self.solution, tau, x)
        mean = mean_payoff(self.simulator, self.solution.policy, tau, x, rollouts, rng)
        return (mean * rollouts).round().cpu().numpy().astype(int)

    def value(self, tau: Tensor, x: Tensor) -> np.ndarray:
        """V (N,) of the run."""
        return self.solution.value(*like(self.solution, tau, x)).double().cpu().numpy()

    def digest(self) -> str:
        """The SHA-256 of all that the policy and V are computed from, in hexadecimal digits."""
        return digest(self.solution.arrays())

    def describe(self) -> dict[str, Any]:
        """The settings of the simulator."""
        simulator = self.simulator
        return {"dt": simulator.dt, "substeps": simulator.substeps, "crossing": simulator.crossing}

    def words(self) -> str:
        """The simulator in words, as the end of a sentence."""
        simulator = self.simulator
        steps = f" of {simulator.substeps} integration steps" if simulator.substeps > 1 else ""
        rule = "by Brownian bridges within a step" if simulator.crossing == "bridge" else "at the ends of steps"
        return f"in the simulator with controls held for {simulator.dt:g} s{steps} and exits found {rule}"
