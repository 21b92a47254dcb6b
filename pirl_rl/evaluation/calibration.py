"""Does the value say what the policy does, over the whole box or where episodes start?"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.inputs import points_rng
from pirl_rl.evaluation.rollout_comparison import RolloutComparison
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates, UniformStates
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


@dataclass(frozen=True)
class CalibrationEvidence:
    """V and Monte Carlo at random states and times to go."""

    comparison: RolloutComparison

    def metrics(self) -> dict[str, float]:
        one = self.comparison
        return {"calibration_mse": one.mse(), "calibration_mae": one.mae(), "calibration_noise": one.noise()}


class Calibration:
    """V against the mean payoff of rollouts, at states of a law of starts and tau uniform in (0, T]: the same points
    and noise at every call.

    Args:
        points: states.
        rollouts: paths from each, at least 2.
        initial_states: the law of the states, whose steps to go are not used; default uniform in the box of states,
            outside A and B.
        seed: of points and noise.
    """

    def __init__(
        self, points: int = 256, rollouts: int = 256, initial_states: InitialStates | None = None, seed: int = 0
    ):
        if points < 1 or rollouts < 2:
            raise ArgumentError(f"Calibration: expected points >= 1 and rollouts >= 2, got {points} and {rollouts}")
        self.points, self.rollouts, self.seed = points, rollouts, seed
        self.initial_states = initial_states or UniformStates()

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        law = type(self.initial_states).__name__
        return {
            "calibration_mse": f"The mean square of V minus Monte Carlo, the mean payoff of {self.rollouts:,} rollouts "
            f"of the learned policy, at {self.points:,} states drawn by {law} and random times to go; V is 1 in A and "
            "0 in B.",
            "calibration_mae": "The mean absolute value of the difference in calibration_mse.",
            "calibration_noise": "The calibration_mse that a perfect V would have: the variance of the Monte Carlo "
            "means.",
        }

    def __call__(self, solution: Solution, simulator: Simulator) -> CalibrationEvidence:
        problem, rng = solution.problem, points_rng(self.seed)
        _, x = self.initial_states.sample(problem, self.points, 1, rng, solution.dtype)
        late = 1 - torch.rand(self.points, generator=rng, dtype=solution.dtype)
        tau = problem.horizon * late.to(solution.device)
        x = x.to(solution.device)
        return CalibrationEvidence(RolloutComparison.measure(solution, simulator, tau, x, self.rollouts, self.seed))
