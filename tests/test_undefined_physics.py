"""Physics without numbers beyond the box of states, where paths may come: they fail, and training goes on."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import pirl_rl
from pirl_rl import Box, ReachAvoidProblem, constant
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.networks import Critic


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


class Barrier(Population):
    """An avoid set whose level is infinite beyond the box."""

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant([[0.3, 0.0], [0.0, 0.3]], x).expand(*x.shape, 2)

    def avoid_level(self, x: Tensor) -> Tensor:
        return torch.where(x[..., 0] > 0, x[..., 1].abs() - 0.5 + x[..., 0].log().abs(), torch.inf)


class Logarithm(Barrier):
    """An avoid set whose level has no number beyond the box."""

    def avoid_level(self, x: Tensor) -> Tensor:
        return 3.2 + x[..., 0].log()


@pytest.mark.parametrize("problem", [Tank, Population, Barrier, Logarithm])
def test_a_training_goes_on_where_paths_leave_the_physics(problem, tmp_path):
    settings = {"updates": 40, "compile": False, "debug": "default", "check": False, "env.num_envs": 256}
    settings |= {
        "collector": {"frames_per_batch": 2_560, "warmup_frames": 2_560, "updates_per_batch": 5, "buffer_size": 5_120}
    }
    settings |= {"env.dt": 0.05, "evaluation": {"during": [], "final": []}}
    run = pirl_rl.train(problem(horizon=2.0), folder=tmp_path, **settings)
    assert math.isfinite(float(run.value(2.0, [[1.0, 0.0]])[0]))


@pytest.mark.parametrize("problem", [Barrier, Logarithm])
def test_networks_take_a_level_without_a_number_for_that_of_a_state_far_outside(problem):
    """Where the level is finite, the input of a network is the level itself."""
    problem = problem(horizon=2.0)
    level = Critic(problem, levels=True).layers[:1](torch.tensor([[1.0, 0.3, 0.2], [1.0, -0.3, 0.2]]))
    assert level[0, -1] == problem.avoid_level(torch.tensor([0.3, 0.2]))
    assert level[1, -1] > problem.avoid_level(problem.states.sample(100)).max() - 0.5
    assert level.isfinite().all()


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
