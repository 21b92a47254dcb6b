"""Physics without numbers beyond the box of states, where paths may come: they fail, and training goes on."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import pirl_rl
from pirl_rl import Box, ReachAvoidProblem, constant
from pirl_rl.evaluation.monte_carlo import monte_carlo


class Tank(ReachAvoidProblem):
    """A tank that empties by Torricelli's law, with a slow temperature beside its height."""

    states, controls = Box([0.05, -1.0], [2.0, 1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        height, warm = x.unbind(-1)
        return torch.stack([0.5 * (u[..., 0] - height.sqrt()), -warm], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant([[0.3, 0.0], [0.0, 0.3]], x).expand(*x.shape, 2)

    def target_level(self, x: Tensor) -> Tensor:
        return 1.6 - x[..., 0]


class Population(Tank):
    """A noise that grows with the root of the size."""

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([0.5 * u[..., 0] - 0.5, -x[..., 1]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(torch.stack([0.3 * x[..., 0].sqrt(), torch.full_like(x[..., 1], 0.3)], -1))


@pytest.mark.parametrize("problem", [Tank, Population])
def test_a_training_goes_on_where_paths_leave_the_physics(problem, tmp_path):
    settings = {"updates": 40, "compile": False, "debug": "default", "check": False, "env.num_envs": 256}
    settings |= {
        "collector": {"frames_per_batch": 2_560, "warmup_frames": 2_560, "updates_per_batch": 5, "buffer_size": 5_120}
    }
    settings |= {"env.dt": 0.05, "evaluation": {"during": [], "final": []}}
    run = pirl_rl.train(problem(horizon=2.0), folder=tmp_path, **settings)
    assert math.isfinite(float(run.value(2.0, [[1.0, 0.0]])[0]))


def test_a_level_without_a_number_is_no_success():
    """A path is driven down from 0.3, and the level has no number below 0."""

    class Sinking(Tank):
        states, controls = Box([0.1], [2.0]), Box([-1.0], [1.0])

        def drift(self, x: Tensor, u: Tensor) -> Tensor:
            return 0 * u - 1.0

        def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
            return (0 * x + 0.1).unsqueeze(-1)

        def target_level(self, x: Tensor) -> Tensor:
            return 1.4 - x[..., 0].sqrt()

    x, tau = torch.tensor([[0.3], [0.5]]), torch.tensor([2.0, 2.0])
    estimate = monte_carlo(Sinking(horizon=2.0), lambda tau, x: 0 * x, tau, x, rollouts=200, dt=0.05, crossing="bridge")
    assert (estimate.probability == 0).all()
