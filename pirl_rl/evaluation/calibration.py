"""Does the value say what the policy does? V against Monte Carlo of the learned policy."""

from __future__ import annotations

from functools import partial
from typing import Literal

import torch

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evidence import points_rng, rng_like
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.sampling.initial_states import InitialStates, UniformStates
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class Calibration:
    """V (masked) against the mean payoff of noise-free rollouts, at states uniform in the box outside A and B, or of a
    law of starts, and tau uniform in (0, T]: the same points and noise at every call.

    Args:
        points: states.
        rollouts: paths from each, at least 2.
        dt: control step, s.
        substeps: integration steps in it.
        crossing: how exits are watched.
        initial_states: the law of the states; its steps to go are not used.
        seed: of points and noise.
    """

    def __init__(
        self,
        points: int = 256,
        rollouts: int = 256,
        dt: float = 0.1,
        substeps: int = 1,
        crossing: Literal["bridge", "endpoint"] = "bridge",
        initial_states: InitialStates | None = None,
        seed: int = 0,
    ):
        if points < 1 or rollouts < 2:
            raise ArgumentError(f"Calibration: expected points >= 1 and rollouts >= 2, got {points} and {rollouts}")
        self.points, self.rollouts, self.seed = points, rollouts, seed
        self.initial_states = initial_states or UniformStates()
        self.simulator = partial(Simulator, dt=dt, substeps=substeps, crossing=crossing)

    def __call__(self, solution: Solution) -> dict[str, float]:
        """calibration_mse, calibration_mae, and calibration_noise, the part of the former that is Monte Carlo's own."""
        problem, rng = solution.problem, points_rng(self.seed)
        _, x = self.initial_states.sample(problem, self.points, 1, rng, solution.dtype)
        x = x.to(solution.device)
        late = 1 - torch.rand(self.points, generator=rng, dtype=solution.dtype)
        tau = problem.horizon * late.to(solution.device)
        noise = rng_like(solution, self.seed)
        mean = mean_payoff(self.simulator(problem), solution.policy, tau, x, self.rollouts, noise)
        error = solution.value(tau, x) - mean
        return {
            "calibration_mse": error.square().mean().item(),
            "calibration_mae": error.abs().mean().item(),
            "calibration_noise": (mean * (1 - mean)).mean().item() / (self.rollouts - 1),
        }
