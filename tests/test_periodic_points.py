"""Periodic coordinates in samplers, the check of a PROBLEM, evaluators and figures."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracles import Circle, Winding, random_solution
from tensordict import TensorDict

from pirl_rl import ReachAvoidProblem
from pirl_rl.errors import ProblemError
from pirl_rl.evaluation import ExactError, Rollouts, Slices
from pirl_rl.evaluation.reference_states import ReferenceStates, displaced
from pirl_rl.figures import draw
from pirl_rl.figures.one_dimensional import evaluate_on_grid
from pirl_rl.figures.planes import broken_at_seams
from pirl_rl.sampling.boundary import BoundarySampler
from pirl_rl.sampling.collocation import Collocation, ReplayCollocation
from pirl_rl.sampling.initial_states import UniformStates, VisitedStates
from pirl_rl.sets import Box, Plane
from pirl_rl.simulator import Simulator
from pirl_rl.structure import check_problem

PROBLEM = Circle()


def assert_on_the_circle(x):
    """Inside the period, and on both sides of the seam."""
    assert ((x >= -1) & (x < 3)).all()
    assert (x < -0.8).any()
    assert (x > 2.8).any()


def test_collocation():
    rng = torch.Generator().manual_seed(0)
    replay = TensorDict({"tau": torch.ones(500, 1), "state": torch.full((500, 1), 2.9)}, [500])
    samplers = (
        Collocation(PROBLEM, 500, "sobol", widen=1.5),
        ReplayCollocation(PROBLEM, 500, replay_share=[1.0, 1.0], jitter=[0.2, 0.2]),
    )
    for sampler in samplers:
        batch = sampler.sample(rng, replay)
        assert_on_the_circle(batch["state"])
        assert torch.equal(batch["mask"], PROBLEM.target_level(batch["state"]) > 0)
    near = (batch["state"] - 2.9 + 2) % 4 - 2
    # Steps of 0.2 in coordinates in which the period is 2 are 0.4 in x: five standard errors of their spread.
    assert near.std().item() == pytest.approx(0.4, abs=5 * 0.4 / 1000**0.5)


def test_initial_states():
    rng = torch.Generator().manual_seed(0)
    visited = torch.full((10, 1), 2.95)
    for law in (UniformStates([-6.0], [-2.0]), VisitedStates(UniformStates(), share=1.0, radius=0.4)):
        _, x = law.sample(PROBLEM, 500, 10, rng, torch.float32, visited)
        assert_on_the_circle(x)
        assert PROBLEM.interior(x).all()


def test_faces_lie_on_both_ends_of_the_arc():
    points = BoundarySampler(PROBLEM, initial=10, faces=400).sample(torch.Generator().manual_seed(0))
    faces = points["state"][10:, 0]
    torch.testing.assert_close(faces.abs(), torch.full((400,), 0.5), rtol=0, atol=1e-6)
    assert 0.1 < (faces > 0).float().mean() < 0.9
    assert (points["value"][10:] == 1).all()


def test_given_faces_are_wrapped():
    class Given(Circle):
        def faces(self, count, rng=None):
            return torch.full((count, 1), 3.5), torch.ones(count)

    points = BoundarySampler(Given(), initial=0, faces=5).sample(torch.Generator().manual_seed(0))
    assert (points["state"] == -0.5).all()


def test_reference_states_pass_the_seam():
    box, rng = Box([0.0, -1.0], [2.0, 3.0], periodic=[1]), torch.Generator().manual_seed(0)
    tau, x = torch.ones(100), torch.full((100, 1), 2.9)
    _, moved = displaced(PROBLEM, tau, x, box, rng, 400, 0.3)
    assert_on_the_circle(moved)
    states = ReferenceStates.from_visited(PROBLEM, tau, x, box, rng, 100, radius=0.1, neighbours=1)
    # 0.1 of half a period is an angle of 0.1 pi, and the distance of sine and cosine is a chord.
    assert states.distance.max() <= 0.1 * math.pi


def test_a_control_that_is_periodic_is_refused():
    class Turning(Circle):
        controls = Box([-1.0], [1.0], periodic=[0])

    with pytest.raises(ProblemError, match="only states may be periodic"):
        check_problem(Turning())


@pytest.mark.parametrize(
    ("method", "what"), [("drift", "drift"), ("diffusion", "diffusion"), ("target_level", "membership of the target")]
)
def test_functions_without_the_period_are_named(method, what):
    wrong = {
        "drift": lambda self, x, u: x,
        "diffusion": lambda self, x, u: (2 + x).unsqueeze(-1),
        "target_level": lambda self, x: (x[..., 0] - 2.8).abs() - 0.5,
    }
    check_problem(Circle())
    problem = type("Wrong", (Circle,), {method: wrong[method]})()
    with pytest.raises(ProblemError, match=f"axis 0 of states is periodic, so its {what} must be the same at both"):
        check_problem(problem)


class Drawn(Winding):
    """Turns fast, and has a plane with the angle, over its whole period."""

    def drift(self, x, u):
        return super().drift(x, u) + torch.tensor([0.0, 4.0, 0.0])

    @property
    def planes(self):
        box = Box([-1.0, self.states.low[1]], [2.0, self.states.high[1]], periodic=[1])
        embed = lambda p: torch.cat([p, torch.zeros_like(p[..., :1])], -1)  # noqa: E731
        return {"plane": Plane(("x (m)", "angle (rad)"), box, embed, lambda x: x[..., :2])}


def test_paths_break_where_they_jump_over_the_seam():
    box = Box([0.0, 0.0], [1.0, 1.0], periodic=[1])
    path = np.array([[0.1, 0.8], [0.9, 0.9], [0.2, 0.1], [0.3, 0.2], [0.3, 0.95]])
    broken = broken_at_seams(path, box)
    assert np.isnan(broken).all(-1).tolist() == [False, False, True, False, False, True, False]
    assert np.array_equal(broken[~np.isnan(broken).all(-1)], path)
    assert np.array_equal(broken_at_seams(path, Box([0.0, 0.0], [1.0, 1.0])), path)


def test_rollouts_and_slices_cover_the_period():
    solution = random_solution(Drawn(), torch.float32)
    simulator = Simulator(solution.problem, 0.3)
    evidence = Rollouts(paths=6, points=5)(solution, simulator)
    (figure,) = draw(evidence).values()
    lines = [line for axes in figure.axes for line in axes.lines if len(line.get_ydata()) > 1]
    jumps = np.concatenate([np.abs(np.diff(np.asarray(line.get_ydata(), dtype=float))) for line in lines])
    assert np.isnan(jumps).any()
    assert np.nanmax(jumps) <= math.pi
    slices = Slices(points=5, rollouts=2)(solution, simulator).slices["plane"]
    first, last = slices.section.value[0], slices.section.value[-1]
    # The grid has both ends of the period, which are the same states.
    torch.testing.assert_close(first, last, rtol=0, atol=1e-5)


def test_one_dimensional_maps_cover_the_period():
    grid = evaluate_on_grid(random_solution(Circle(), torch.float32), 5, 9)
    assert (grid.x[0], grid.x[-1]) == (-1, 3)
    assert np.allclose(grid.value[0], grid.value[-1], atol=1e-5)
    assert np.isfinite(grid.exact).all()
    metrics = ExactError(5, 9)(random_solution(Circle(), torch.float32), Simulator(Circle())).metrics()
    assert all(math.isfinite(value) for value in metrics.values())


def test_physics_without_numbers_beyond_another_edge_has_a_period():
    class Polar(ReachAvoidProblem):
        """A drift with the logarithm of the radius, which has no number at negative radii."""

        states, controls = Box([0.1, -math.pi], [2.0, math.pi], periodic=[1]), Box([-1.0], [1.0])

        def drift(self, x, u):
            return torch.cat([0.5 * u - 0.1 * x[..., :1].log(), x[..., 1:].sin()], -1)

        def diffusion(self, x, u):
            return torch.diag_embed(0 * x + 0.3)

        def target_level(self, x):
            return 1.6 - x[..., 0]

    check_problem(Polar(horizon=2.0))
