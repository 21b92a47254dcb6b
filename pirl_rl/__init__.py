"""Stochastic reach-avoid analysis of controlled systems by physics-informed reinforcement learning."""

from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.runs.load import Run, load_run
from pirl_rl.sets import Box

__all__ = ["Box", "ReachAvoidProblem", "Run", "load_run", "monte_carlo"]
