"""The default recipe sees a problem through its box, horizon and controls: in other units it learns the same."""

from __future__ import annotations

import pytest
import torch

import pirl_rl
from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.cubature import absorbing_faces, continued_value, free_step
from pirl_rl.layers import LogLevels
from pirl_rl.networks import Actor, Critic
from pirl_rl.problems import DoubleIntegrator
from pirl_rl.rates import across_sets
from pirl_rl.sampling.boundary import face_weights
from pirl_rl.sampling.faces import find_faces
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

LENGTHS, TIME, FORCE, LEVELS = torch.tensor([1e3, 1e-3], dtype=torch.float64), 1e-2, 1e4, (100.0, 1e-3)
SETTINGS = {
    "seed": 0,
    "updates": 12,
    "debug": "default",
    "figures": False,
    "evaluation": {"during": [], "final": []},
    "collector": {"frames_per_batch": 6_400, "warmup_frames": 6_400, "buffer_size": 12_800, "updates_per_batch": 4},
}


class InOtherUnits(ReachAvoidProblem):
    """The double integrator in millimetres, km/s and hundreds of seconds, with rescaled controls and levels."""

    original = DoubleIntegrator()
    horizon = TIME * original.horizon
    states = Box(*(torch.tensor(corner) * LENGTHS for corner in (original.states.low, original.states.high)))  # type: ignore[arg-type]
    controls = Box([-FORCE], [FORCE])

    def drift(self, x, u):
        return self.original.drift(x / LENGTHS.to(x), u / FORCE) * LENGTHS.to(x) / TIME

    def diffusion(self, x, u):
        return self.original.diffusion(x / LENGTHS.to(x), u / FORCE) * (LENGTHS / TIME**0.5).to(x).unsqueeze(-1)

    def target_constraints(self, x):
        return LEVELS[0] * self.original.target_constraints(x / LENGTHS.to(x))

    def avoid_constraints(self, x):
        return LEVELS[1] * self.original.avoid_constraints(x / LENGTHS.to(x))


@pytest.mark.parametrize("unit", [2.0**-60, 2.0**-30, 2.0**66])
def test_levels_in_an_extreme_unit_give_the_same_exits_faces_and_weights(unit):
    """The squares of the levels leave single precision, or their slopes are below what an optimiser notices."""

    class Thin(DoubleIntegrator):
        scale = 1.0

        def target_constraints(self, x):
            return self.scale * (x - x.new_tensor([0.3, 0.2])).square().sum(-1, keepdim=True) - self.scale * 1e-6

        def avoid_constraints(self, x):
            return self.scale * super().avoid_constraints(x)

    class Scaled(Thin):
        scale = unit

    rng = torch.Generator().manual_seed(0)
    x, u = Thin.states.sample(4_000, rng), Thin.controls.sample(4_000, rng)
    x[:2_000] = x.new_tensor([0.3, 0.2]) + 0.1 * (x[:2_000] - 0.3)
    outcomes = []
    for problem in (Thin(), Scaled()):
        interior = problem.interior(x)
        step = Simulator(problem, 0.1, 2).step(x[interior], u[interior], torch.Generator().manual_seed(1))
        faces = find_faces(problem, torch.Generator().manual_seed(0))
        weights = face_weights(problem, faces.points[::64], faces.values[::64])
        outcomes.append((step.reached, step.failed, weights.mean(), faces.values.sum()))
    (reached, failed, weight, count), (*exits, other_weight, other_count) = outcomes
    assert torch.equal(reached, exits[0])
    assert torch.equal(failed, exits[1])
    assert min(reached.sum(), failed.sum()) > 10
    assert abs(weight - other_weight) < 0.02
    assert count == other_count == 8_192


@pytest.mark.parametrize("method", ["pirl", pytest.param("pinn", marks=pytest.mark.slow)])
def test_a_problem_in_other_units_is_learned_alike(method, tmp_path):
    """Two batches are collected and twelve updates made; only rounding may differ, in single precision."""
    runs = [
        pirl_rl.train(problem, folder=tmp_path / name, method=method, **SETTINGS)
        for name, problem in (("original", DoubleIntegrator()), ("other", InOtherUnits()))
    ]
    rng = torch.Generator().manual_seed(1)
    x = runs[0].problem.states.sample(500, rng, torch.float64)
    tau = runs[0].problem.horizon * torch.rand(500, generator=rng, dtype=torch.float64)
    values = runs[0].value(tau, x), runs[1].value(TIME * tau, LENGTHS * x)
    controls = runs[0].policy(tau, x), runs[1].policy(TIME * tau, LENGTHS * x) / FORCE
    assert values[0].std() > 0.05
    torch.testing.assert_close(values[1], values[0], atol=1e-4, rtol=0)
    torch.testing.assert_close(controls[1], controls[0], atol=1e-3, rtol=0)
    assert abs(runs[1].simulator.dt / TIME - runs[0].simulator.dt) < 1e-12


class Slab(ReachAvoidProblem):
    """A thin target between four pairs of oblique planes, each with a level in a unit of its own."""

    horizon, states, controls = 1.0, Box([-1] * 4, [1] * 4), Box([-1], [1])
    scales = (1.0, 1.0, 1.0, 1.0)

    def drift(self, x, u):
        return u.expand(*x.shape[:-1], 4)

    def diffusion(self, x, u):
        return 0.3 * torch.eye(4).to(x).expand(*x.shape[:-1], 4, 4)

    def target_constraints(self, x):
        normals = torch.linalg.qr(torch.randn(4, 4, generator=torch.Generator().manual_seed(1)).double())[0]
        return torch.tensor(self.scales).to(x) * ((x @ normals.to(x) - 0.1).abs() - 0.01)


@pytest.mark.parametrize("scales", [(1.0, 1e2, 1.0, 1e2), (1.0, 1e5, 1e-3, 1e5)])
def test_a_thin_target_is_found_where_each_level_has_a_unit_of_its_own(scales):
    problem = type("Scaled", (Slab,), {"scales": scales})()
    assert len(find_faces(problem, torch.Generator().manual_seed(0)).points) == 8_192
    x = problem.states.sample(4_000, torch.Generator().manual_seed(0), torch.float64)
    u = problem.controls.sample(4_000, torch.Generator().manual_seed(1), torch.float64)
    for one, other in zip(across_sets(Slab(), x, u), across_sets(problem, x, u), strict=True):
        assert (other.speed, other.spread) == pytest.approx((one.speed, one.spread), rel=0.3)


class Corner(ReachAvoidProblem):
    """A square target and two walls, with a level of the second coordinate in a small unit."""

    horizon, states, controls = 1.0, Box([-1, -1], [1, 1]), Box([-1, -1], [1, 1])
    unit = 1.0

    def drift(self, x, u):
        return u

    def diffusion(self, x, u):
        return torch.diag_embed(0.1 + 0.2 * u.abs())

    def target_constraints(self, x):
        return torch.stack([x[..., 0].abs() - 0.5, self.unit * (x[..., 1].abs() - 0.5)], -1)

    def avoid_constraints(self, x):
        return torch.stack([x[..., 0] + 0.9, self.unit * (x[..., 1] + 0.9)], -1)


def test_the_nearest_face_is_that_of_the_shortest_way_and_not_of_the_smallest_level():
    one, other = Corner(), type("Millimetres", (Corner,), {"unit": 1_000.0})()
    inside = torch.tensor([[0.1, 0.499], [0.499, 0.1], [-0.2, -0.45]])
    outside = torch.tensor([[0.5, -0.898], [-0.898, 0.7], [0.52, 0.1]])
    for problem in (one, other):
        assert problem.reached(inside).all()
        assert problem.interior(outside).all()
    actor, critic = Actor(one, [8]), Critic(one, [8], action_input=False)
    found = [
        continued_value(Solution(problem, actor, critic), torch.full((3,), 0.5), inside) for problem in (one, other)
    ]
    torch.testing.assert_close(*found)
    lengths = [
        free_step(problem, outside, absorbing_faces(problem, outside), [0, 1], 1e-9, 0.1) for problem in (one, other)
    ]
    torch.testing.assert_close(*lengths)
    assert lengths[0].max() < 0.1


def test_the_continuation_of_v_does_not_depend_on_the_units_of_the_states():
    """The faces are oblique, so that a mirror image along the gradient would lie elsewhere in other units."""

    class Oblique(Slab):
        units = (1.0, 1.0, 1.0, 1.0)

        def target_constraints(self, x):
            return super().target_constraints(x / torch.tensor(self.units).to(x)) - 0.29

        def avoid_constraints(self, x):
            return (1.5 - (x / torch.tensor(self.units).to(x))[..., :2].sum(-1)).unsqueeze(-1)

    class Millimetres(Oblique):
        units = (1.0, 1e3, 1.0, 1e-3)
        states = Box([-size for size in units], units)

    problem, other = Oblique(), Millimetres()
    torch.manual_seed(0)
    actor, critic = Actor(problem, (8,)), Critic(problem, (8, 8), output="Sigmoid")
    twin = Critic(other, (8, 8), output="Sigmoid")
    weights = {key: value for key, value in critic.state_dict().items() if key.endswith(("weight", "bias"))}
    assert not twin.load_state_dict(weights, strict=False).unexpected_keys
    x = 2 * torch.rand(4_000, 4) - 1
    inside = x[problem.reached(x) | problem.failed(x)]
    assert min(problem.reached(x).sum(), problem.failed(x).sum()) > 10
    tau = torch.full((len(inside),), 0.5)
    expected = continued_value(Solution(problem, actor, critic), tau, inside)
    found = continued_value(Solution(other, actor, twin), tau, inside * torch.tensor(other.units))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_a_free_step_sees_noise_that_two_opposite_corners_of_the_controls_do_not_have():
    class Difference(Corner):
        def diffusion(self, x, u):
            return 0.3 * (u[..., :1] - u[..., 1:]).unsqueeze(-1).expand(*x.shape[:-1], 2, 1)

    class Middle(Corner):
        def diffusion(self, x, u):
            return 0.3 * (1 - u[..., :1] ** 2).unsqueeze(-1).expand(*x.shape[:-1], 2, 1)

    x = torch.tensor([[-0.899, 0.7]])
    for problem in (Difference(), Middle()):
        # A noise of 0.3 goes half of the millimetre to the wall within (0.0005/0.3)^2 s.
        length = free_step(problem, x, absorbing_faces(problem, x), [0], 1e-9, 0.1)
        assert length.item() == pytest.approx((0.0005 / 0.3) ** 2, rel=1e-3)


def test_levels_that_are_huge_deep_in_a_set_have_the_resolution_of_others():
    class Disc(Corner):
        def avoid_constraints(self, x):
            return x.norm(dim=-1, keepdim=True) - 0.2

    class Singular(Corner):
        def avoid_constraints(self, x):
            return 625 - x.norm(dim=-1, keepdim=True) ** -4

    levels = []
    for problem in (Disc(), Singular()):
        logs = next(
            layer for layer in Critic(problem, levels=True, log_levels=True).layers if isinstance(layer, LogLevels)
        )
        faces = torch.tensor([[1.0, 0.202, 0.0], [1.0, 0.3, 0.0]])
        levels.append(logs(Critic(problem, levels=True).layers[:1](faces))[:, -1])
    # 2 mm and 10 cm outside of the disc: both inputs tell them apart.
    assert all(level[1] - level[0] > 1 for level in levels)
