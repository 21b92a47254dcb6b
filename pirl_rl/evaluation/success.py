"""The probability that the learned policy succeeds from the distribution of initial states."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pirl_rl.arguments import Policy
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evaluator import Metrics
from pirl_rl.evaluation.inputs import points_rng
from pirl_rl.evaluation.monte_carlo import mean_payoff, wilson_interval
from pirl_rl.problem import ReachAvoidProblem, with_indicator
from pirl_rl.sampling.initial_states import InitialStates, UniformStates
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class Success:
    """Plays episodes of whole control steps, like the environment, but without exploration noise.

    Starts and noise are the same at every call.

    Args:
        episodes: number of episodes.
        initial_states: distribution of x and of the steps to go; the default is uniform in both.
        seed: seed of starts and noise.

    Raises:
        ArgumentError: if there is no episode.
    """

    def __init__(self, episodes: int = 10_000, initial_states: InitialStates | None = None, seed: int = 0):
        if episodes < 1:
            raise ArgumentError(f"Success: expected episodes >= 1, got {episodes}")
        self.episodes, self.seed, self.initial_states = episodes, seed, initial_states or UniformStates()

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        goal = "stay out of B" if problem.objective == "invariance" else "reach A before B"
        meanings = {
            "success_rate": f"The share of {self.episodes:,} episodes without exploration noise that {goal}, from "
            f"starts drawn by {type(self.initial_states).__name__}; the hard sets count, whatever the payoff is.",
            "success_low": "The lower end of the approximate 95% interval of success_rate (Wilson 1927).",
            "success_high": "The upper end of the approximate 95% interval of success_rate (Wilson 1927).",
            "reward": "The mean payoff of the same episodes, equal to success_rate for the hard payoff.",
            "value_spread": "The standard deviation of the V of the networks, or of the grid, clamped to [0, 1], over "
            "the starts of the same episodes; it is 0 if V is constant.",
        }
        if _optimum_is_known(problem, *_one_point(problem)):
            meanings["optimal_reward"] = "The reward of the optimal control from the same starts, with the same seed."
        return meanings

    def __call__(self, solution: Solution, simulator: Simulator) -> Metrics:
        problem, rng = solution.problem, points_rng(self.seed)
        clock = simulator.clock
        steps, x = self.initial_states.sample(problem, self.episodes, clock.max_steps, rng, solution.dtype)
        tau, x = clock.time(steps).to(solution.device, solution.dtype), x.to(solution.device)
        reward = rate = self._mean(simulator, solution.policy, tau, x)
        if problem.payoff.epsilon > 0:
            hard = dataclasses.replace(simulator, problem=with_indicator(problem))
            rate = self._mean(hard, solution.policy, tau, x)
        low, high = wilson_interval(rate * self.episodes, self.episodes)
        metrics = {
            "success_rate": rate,
            "success_low": low,
            "success_high": high,
            "reward": reward,
            "value_spread": solution.raw_value(tau, x).clamp(0, 1).std(correction=0).item(),
        }
        if _optimum_is_known(problem, tau[:1], x[:1]):
            metrics["optimal_reward"] = self._mean(simulator, problem.optimal_control, tau, x)  # type: ignore[arg-type]
        return Metrics(metrics)

    def _mean(self, simulator: Simulator, policy: Policy, tau: Tensor, x: Tensor) -> float:
        rng = torch.Generator(x.device).manual_seed(self.seed)
        return mean_payoff(simulator, policy, tau, x, 1, rng).mean().item()


def _optimum_is_known(problem: ReachAvoidProblem, tau: Tensor, x: Tensor) -> bool:
    return problem.optimal_control(tau, x) is not None


def _one_point(problem: ReachAvoidProblem) -> tuple[Tensor, Tensor]:
    """The whole horizon (1,) and the center (1, n) of the box of states."""
    tau = torch.full((1,), problem.horizon)
    return tau, problem.states.center_and_half_width(tau)[0].unsqueeze(0)
