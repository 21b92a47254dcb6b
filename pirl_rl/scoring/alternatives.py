"""What a user would take in place of the recipe, at the same states: the success of other policies, the grid's time."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch

from pirl_rl.errors import ArgumentError
from pirl_rl.grid import GridSolver
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.rivals import find_rival
from pirl_rl.scoring.score import successes
from pirl_rl.scoring.truth import GRID_POINTS, Truth
from pirl_rl.simulator import Simulator

COARSEST = 31
"""The number of nodes along each axis of the first grid that is tried."""


@dataclass(frozen=True)
class Alternative:
    """The quality of another way to solve a problem.

    Attributes:
        seconds: the time that it took, in s.
        success: the mean success of its policy, or NaN for the grid.
        success_error: the standard error of `success`.
        mse: the mean square of V minus the truth, or NaN for a policy alone.
        processor: the time of the processor that the grid took, in s, or NaN for a policy.
    """

    seconds: float
    success: float = math.nan
    success_error: float = math.nan
    mse: float = math.nan
    processor: float = math.nan


def play_rival(
    name: str, problem: ReachAvoidProblem, simulator: Simulator, truth: Truth, seconds: float, rollouts: int, seed: int
) -> Alternative | None:
    """The success of a rival that trains for a given time, or None where it does not suit the problem.

    Raises:
        ArgumentError: there is no such rival, or its packages are not installed.
    """
    rival, started = find_rival(name), time.perf_counter()
    try:
        policy = rival(problem, simulator, seconds, seed)
    except ArgumentError:
        return None
    spent = time.perf_counter() - started
    success = successes(simulator, policy, truth, torch.arange(len(truth.tau)), rollouts)
    error = (success * (1 - success) / rollouts).sum().sqrt().item() / len(success)
    return Alternative(spent, success.mean().item(), error)


def race_grid(problem: ReachAvoidProblem, truth: Truth, mse: float) -> Alternative | None:
    """The time of the coarsest grid whose error is at most `mse`; None without a truth, or if no grid reaches it.

    The number of nodes is doubled until then. Where the truth itself comes from a grid, only coarser ones take part.
    """
    if truth.value is None or problem.states.dim not in GRID_POINTS:
        return None
    points, finest = COARSEST, GRID_POINTS[problem.states.dim]
    while points < finest:
        started, began = time.perf_counter(), time.process_time()
        solution = GridSolver(problem, points).solve()
        error = (solution.value(truth.tau, truth.x) - truth.value).square().mean().item()
        if error <= mse:
            return Alternative(time.perf_counter() - started, mse=error, processor=time.process_time() - began)
        points = 2 * points - 1
    return None
