"""What a run has reached: V against the truth, its policy against the truth, and V against its own policy."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from pirl_rl.arguments import Policy
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.files import replacing
from pirl_rl.scoring.truth import Truth
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

SUSPECTS = 20
"""The number of states with the largest losses whose success is measured once more, with new random numbers."""

MORE = 10
"""How many times as many rollouts that second measurement has."""

NORMAL = math.sqrt(2 / math.pi)
"""The mean absolute value of a standard normal variable."""


@dataclass(frozen=True)
class Score:
    """The measured quality of one run; entries without a truth are NaN.

    Attributes:
        mse: the mean square of V minus the truth.
        mean_error: the mean of |V - truth|.
        largest_error: the largest |V - truth|.
        success: the mean success of the learned policy, by Monte Carlo.
        loss: the mean of truth minus success.
        loss_error: the standard error of `success` and `loss`.
        largest_loss: the largest truth minus success of a state, measured again at the states where it seemed largest.
        gap: the mean of |V - Monte Carlo| of the learned policy.
        gap_noise: the part of `gap` that is Monte Carlo's own noise.
        seconds: the time of training, in s.
        updates: the number of updates.
    """

    mse: float
    mean_error: float
    largest_error: float
    success: float
    loss: float
    loss_error: float
    largest_loss: float
    gap: float
    gap_noise: float
    seconds: float
    updates: int

    @classmethod
    def load(cls, path: Path) -> Score:
        """The score in a JSON file that `save` wrote."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))

    def save(self, path: Path) -> None:
        """Write the score to a JSON file."""
        with replacing(path) as file:
            file.write(json.dumps(asdict(self), indent=2) + "\n")


def measure(
    solution: Solution, simulator: Simulator, truth: Truth, rollouts: int, seconds: float, updates: int, seed: int = 1
) -> Score:
    """Measure a solution at the states of a truth.

    Args:
        solution: the networks.
        simulator: plays the paths.
        truth: the states and their reference values.
        rollouts: the number of paths from each state.
        seconds: the time of training, in s.
        updates: the number of updates.
        seed: of the paths.
    """

    def played(index: torch.Tensor, count: int, seed: int) -> torch.Tensor:
        return successes(simulator, solution.policy, truth, index, count, seed)

    everything = torch.arange(len(truth.tau))
    success, value = played(everything, rollouts, seed), solution.value(truth.tau, truth.x).double()
    variance = success * (1 - success) / rollouts
    mse = mean_error = largest_error = loss = largest_loss = math.nan
    if truth.value is not None:
        error, lost = value - truth.value, truth.value - success
        mse, mean_error = error.square().mean().item(), error.abs().mean().item()
        largest_error, loss = error.abs().max().item(), lost.mean().item()
        # The largest of many noisy losses is mostly noise, unless the suspects are measured again.
        suspects = lost.argsort(descending=True)[:SUSPECTS]
        largest_loss = (truth.value[suspects] - played(suspects, MORE * rollouts, seed + 1)).max().item()
    return Score(
        mse=mse,
        mean_error=mean_error,
        largest_error=largest_error,
        success=success.mean().item(),
        loss=loss,
        loss_error=variance.sum().sqrt().item() / len(variance),
        largest_loss=largest_loss,
        gap=(value - success).abs().mean().item(),
        gap_noise=NORMAL * variance.sqrt().mean().item(),
        seconds=seconds,
        updates=updates,
    )


def successes(
    simulator: Simulator, policy: Policy, truth: Truth, index: torch.Tensor, rollouts: int, seed: int = 1
) -> torch.Tensor:
    """The success (K,) of a policy, by Monte Carlo, at the states of a truth with the given indices (K,)."""
    dtype, rng = torch.get_default_dtype(), torch.Generator().manual_seed(seed)
    return mean_payoff(simulator, policy, truth.tau[index].to(dtype), truth.x[index].to(dtype), rollouts, rng)
