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
from pirl_rl.rates import across_sets


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
    settings = {"updates": 40, "compile": False, "debug": "default", "check": False, "figures": False}
    settings |= {
        "collector": {"frames_per_batch": 2_560, "warmup_frames": 2_560, "updates_per_batch": 5, "buffer_size": 5_120}
    }
    settings |= {"env.num_envs": 256, "env.dt": 0.05, "evaluation": {"during": [], "final": []}}
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


class Spiked(Tank):
    """An avoid set whose level is infinite in a part of the box."""

    def avoid_level(self, x: Tensor) -> Tensor:
        return torch.where(x[..., 0] < 1.9, x[..., 1].abs() - 0.1, torch.inf)


def test_a_level_that_is_infinite_in_a_part_of_the_box_is_an_input_of_networks():
    level = Critic(Spiked(horizon=2.0), levels=True).layers[:1](torch.tensor([[1.0, 1.0, 0.4], [1.0, 1.95, 0.4]]))
    torch.testing.assert_close(level[:, -1], torch.tensor([0.3, 0.9]), atol=0.01, rtol=0)


def test_membership_of_one_constraint_needs_no_number_of_another():
    class Two(Tank):
        def avoid_constraints(self, x: Tensor) -> Tensor:
            return torch.stack([x[..., 1], 0.1 - x[..., 0].log()], -1)

    assert Two(horizon=2.0).failed(torch.tensor([[-0.1, -0.5], [1.0, 0.5], [-0.1, 0.5]])).tolist() == [
        True,
        False,
        False,
    ]


def test_physics_without_a_number_inside_a_set_has_the_rates_beside_it():
    class Root(Tank):
        states = Box([-1.0], [1.0])

        def drift(self, x: Tensor, u: Tensor) -> Tensor:
            return 8 * u + (x.abs() - 0.02).sqrt()

        def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
            return torch.full_like(x, 0.02).unsqueeze(-1)

        def avoid_level(self, x: Tensor) -> Tensor:
            return x[..., 0].abs() - 0.02

    class Clamped(Root):
        def drift(self, x: Tensor, u: Tensor) -> Tensor:
            return 8 * u + (x.abs() - 0.02).clamp(min=0).sqrt()

    rng = torch.Generator().manual_seed(0)
    x, u = (box.sample(4_000, rng, torch.float64) for box in (Root.states, Root.controls))
    found = [across_sets(problem(horizon=2.0), x, u)[-1] for problem in (Root, Clamped)]
    assert found[0].speed == pytest.approx(found[1].speed, rel=0.2)
    assert found[0].spread == pytest.approx(found[1].spread, rel=0.2)
