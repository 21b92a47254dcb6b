"""Calibration: the value against Monte Carlo of its policy, over the whole box or where episodes start."""

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
        comparison = self.comparison
        return {
            "calibration_mse": comparison.mse(),
            "calibration_mae": comparison.mae(),
            "calibration_noise": comparison.noise(),
        }


class Calibration:
    """Compares V with the mean payoff of rollouts at random states, with tau uniform in (0, T].

    Points and noise are the same at every call.

    Args:
        points: number of states.
        rollouts: number of paths from each state, at least 2.
        initial_states: distribution of the states; its steps to go are not used. The default is uniform in the box of
            states, outside A and B.
        seed: seed of points and noise.

    Raises:
        ArgumentError: if there is no point, or fewer than two rollouts.
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
            f"of the policy, at {self.points:,} states drawn by {law} and random times to go; V is 1 in A and "
            "0 in B.",
            "calibration_mae": "The mean absolute value of the difference in calibration_mse.",
            "calibration_noise": "The calibration_mse that a perfect V would have: the variance of the Monte Carlo "
            "means.",
        }

    def __call__(self, solution: Solution, simulator: Simulator) -> CalibrationEvidence:
        problem, rng = solution.problem, points_rng(self.seed)
        _, x = self.initial_states.sample(problem, self.points, 1, rng, solution.dtype)
        fraction = 1 - torch.rand(self.points, generator=rng, dtype=solution.dtype)
        tau = problem.horizon * fraction.to(solution.device)
        x = x.to(solution.device)
        return CalibrationEvidence(RolloutComparison.measure(solution, simulator, tau, x, self.rollouts, self.seed))
