"""How often the learned policy succeeds from the initial law of the episodes."""

from __future__ import annotations

import copy
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evidence import points_rng
from pirl_rl.evaluation.monte_carlo import Policy, mean_payoff, wilson_interval
from pirl_rl.payoffs import Indicator
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates, UniformStates
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class Success:
    """Noise-free episodes of whole steps, as the environment plays them; the same starts and seed at every call.

    Args:
        episodes: how many.
        dt: control step, s.
        substeps: integration steps in it.
        crossing: how exits are watched.
        initial_states: the law of x and of the steps to go; default uniform, steps to go random.
        seed: of starts and noise.
    """

    def __init__(
        self,
        episodes: int = 10_000,
        dt: float = 0.1,
        substeps: int = 1,
        crossing: Literal["bridge", "endpoint"] = "bridge",
        initial_states: InitialStates | None = None,
        seed: int = 0,
    ):
        if episodes < 1:
            raise ArgumentError(f"Success: expected episodes >= 1, got {episodes}")
        self.episodes, self.seed, self.initial_states = episodes, seed, initial_states or UniformStates()
        self.simulator = partial(Simulator, dt=dt, substeps=substeps, crossing=crossing)

    def __call__(self, solution: Solution) -> dict[str, float]:
        """success_rate with its 95% interval (success_low, success_high), reward, value_spread, and if known
        optimal_reward."""
        problem, rng = solution.problem, points_rng(self.seed)
        dt = self.simulator(problem).dt
        max_steps = round(problem.horizon / dt)
        steps, x = self.initial_states.sample(problem, self.episodes, max_steps, rng, solution.dtype)
        tau, x = (steps * dt).to(solution.device, solution.dtype), x.to(solution.device)
        reward = rate = self._mean(problem, solution.policy, tau, x)
        if problem.payoff.epsilon > 0:
            hard = copy.copy(problem)
            hard.payoff = Indicator()
            rate = self._mean(hard, solution.policy, tau, x)
        low, high = wilson_interval(rate * self.episodes, self.episodes)
        spread = solution.raw_value(tau, x).clamp(0, 1).std(correction=0).item()
        metrics = {
            "success_rate": rate,
            "success_low": low,
            "success_high": high,
            "reward": reward,
            "value_spread": spread,
        }
        if problem.optimal_control(tau[:1], x[:1]) is not None:
            metrics["optimal_reward"] = self._mean(problem, problem.optimal_control, tau, x)  # type: ignore[arg-type]
        return metrics

    def _mean(self, problem: ReachAvoidProblem, policy: Policy, tau: Tensor, x: Tensor) -> float:
        rng = torch.Generator(x.device).manual_seed(self.seed)
        return mean_payoff(self.simulator(problem), policy, tau, x, 1, rng).mean().item()
