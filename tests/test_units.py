"""The default recipe sees a problem through its box, horizon and controls: in other units it learns the same."""

from __future__ import annotations

import pytest
import torch

import pirl_rl
from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.problems import DoubleIntegrator
from pirl_rl.sampling.boundary import face_weights
from pirl_rl.sampling.faces import find_faces
from pirl_rl.simulator import Simulator

LENGTHS, TIME, FORCE, LEVELS = torch.tensor([1e3, 1e-3], dtype=torch.float64), 1e-2, 1e4, (100.0, 1e-3)
SETTINGS = {
    "seed": 0,
    "updates": 12,
    "debug": "default",
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


def test_a_problem_in_other_units_is_learned_alike(tmp_path):
    """Two batches are collected and twelve updates made; only rounding may differ, in single precision."""
    runs = [
        pirl_rl.train(problem, folder=tmp_path / name, **SETTINGS)
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
