"""Slices of the state space and paths in them, on problems whose value and vector field are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from matplotlib.image import imread
from matplotlib.quiver import Quiver

from pirl_rl.evaluation import Rollouts, Slices, evaluate
from pirl_rl.evaluation.slices import Section, projected_field
from pirl_rl.figures import draw, draw_run
from pirl_rl.problems import Reach1D, VehicleDrift
from pirl_rl.problems.drift.equilibria import equilibrium
from pirl_rl.sets import Box, Plane
from pirl_rl.simulator import Simulator


class Walk(Reach1D):
    """reach1d with a second coordinate that turns at 1 rad/s; the plane's second axis comes first in the state."""

    states = Box([-math.pi, -2.0], [math.pi, 2.0])

    def drift(self, x, u):
        return torch.cat([torch.ones_like(u), u], -1)

    def diffusion(self, x, u):
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape[:-1], 2, 1)

    def target_level(self, x):
        return 2 - x[..., 1]

    def exact_value(self, tau, x):
        return super().exact_value(tau, x[..., 1:])

    @property
    def planes(self):
        box = Box([-2.0, -1.0], [2.5, 1.0])
        return {"walk_angle": Plane(("x (m)", "angle (rad)"), box, lambda p: p.flip(-1), lambda x: x.flip(-1))}


class Known:
    """Stands for a `Solution`: u = 1 and its exact value."""

    dtype, device = torch.float64, torch.device("cpu")

    def __init__(self, problem):
        self.problem = problem

    def policy(self, tau, x):
        return torch.ones_like(x[..., :1])

    def value(self, tau, x):
        return self.problem.exact_value(tau, x)

    raw_value = value


def test_slice_of_the_exact_value():
    """Mean |MC - V| of a mean of k draws of variance s^2 is about s sqrt(2/(pi k)); the mean over 15 x 15 states is
    known to 4 standard errors."""
    rollouts = 400
    solution = Known(Walk())
    evidence = Slices(15, rollouts)(solution, Simulator(solution.problem, dt=0.1, substeps=1, crossing="bridge"))
    numbers = evidence.metrics()
    assert set(numbers) == {"slice_walk_angle_tau", "slice_walk_angle_mae", "slice_walk_angle_success"}
    assert numbers["slice_walk_angle_tau"] == 2.0
    x = torch.linspace(-2, 2.5, 15, dtype=torch.float64)
    exact = Reach1D().exact_value(torch.full_like(x, 2.0), x.unsqueeze(-1))
    spread = (exact * (1 - exact)).sqrt()
    assert numbers["slice_walk_angle_mae"] == pytest.approx(
        spread.mean().item() * (2 / math.pi / rollouts) ** 0.5, rel=0.2
    )
    error = (spread.square().mean().item() / (15 * 15 * rollouts)) ** 0.5
    assert numbers["slice_walk_angle_success"] == pytest.approx(exact.mean().item(), abs=4 * error)
    # The first axis runs along the rows; states in the target need no paths.
    cut = evidence.slices["walk_angle"]
    assert torch.allclose(cut.section.value[4], exact)
    assert (cut.monte_carlo[:, x >= 2] == 1).all()


@pytest.mark.parametrize(("speed", "time"), [(1.0, 2.0), (8.0, 0.25), (math.inf, 2.0)])
def test_a_section_is_at_the_longest_time_to_go_at_which_v_varies(speed, time):
    """V = 1 where the target, from x = 2, can be reached at a speed, and 0 elsewhere; at infinite speed V = 1."""

    class Fast(Known):
        def value(self, tau, x):
            return (2 - x[..., 1] <= speed * tau).to(x.dtype)

    solution = Fast(Walk())
    plane = solution.problem.planes["walk_angle"]
    section = Section.telling(solution, plane, 21)
    assert section.time == time
    if math.isfinite(speed):
        assert 0 < section.value.mean() < 1
    evidence = Rollouts(1, 21)(solution, Simulator(solution.problem, dt=0.1))
    assert evidence.paths is not None
    assert evidence.paths.tau[0].unique().item() == time


def test_field_of_a_plane_in_other_coordinates():
    """A rotation, seen in polar coordinates, is (0, 1) everywhere."""

    class Turning(Walk):
        def drift(self, x, u):
            return torch.stack([-x[..., 1], x[..., 0]], -1)

        @property
        def planes(self):
            polar = Plane(
                ("radius (m)", "angle (rad)"),
                Box([0.5, -1.0], [1.5, 1.0]),
                lambda p: torch.stack([p[..., 0] * p[..., 1].cos(), p[..., 0] * p[..., 1].sin()], -1),
                lambda x: torch.stack([x.norm(dim=-1), torch.atan2(x[..., 1], x[..., 0])], -1),
            )
            return {"polar": polar}

    solution = Known(Turning())
    field = projected_field(solution, Section.of(solution, solution.problem.planes["polar"], 5, 2.0))
    assert torch.allclose(field, torch.tensor([0.0, 1.0], dtype=torch.float64).expand(25, 2), atol=1e-6)


def test_field_at_the_drift_equilibrium_vanishes():
    """Under its own control, in both planes; to 1e-4, for the table of equilibria is linear between its knots."""
    force = torch.tensor(equilibrium(0.55)[1])

    class Held(Known):
        def policy(self, tau, x):
            return force.expand(len(x), 2)

        def value(self, tau, x):
            return torch.zeros_like(tau)

    problem = VehicleDrift()
    solution = Held(problem)
    center = problem.around_equilibrium(torch.tensor([0.55], dtype=torch.float64))
    for plane in problem.planes.values():
        middle = plane.project(center)[0].tolist()
        around = Plane(
            plane.axes, Box([c - 0.1 for c in middle], [c + 0.1 for c in middle]), plane.embed, plane.project
        )
        field = projected_field(solution, Section.of(solution, around, 3, problem.horizon))
        assert field[4].abs().max() < 1e-4
        assert field[0].abs().max() > 1e-2


@pytest.fixture(scope="module")
def measured():
    simulator = Simulator(Walk(), dt=0.1, substeps=1, crossing="endpoint")
    evidence = Rollouts(paths=4, points=41)(Known(Walk()), simulator)
    assert evidence.metrics() == {}
    return evidence


def test_rollouts_start_where_the_value_is_asked_for(measured):
    """Grid points of the plane lie 0.11 apart in x, over which V changes by at most 0.04."""
    paths, walk = measured.paths, Walk()
    start = walk.exact_value(paths.tau[0].double(), paths.state[0].double())
    assert start.tolist() == pytest.approx([0.9] * 4 + [0.5] * 4 + [0.1] * 4, abs=0.02)
    assert [value for value in measured.values for _ in range(4)] == pytest.approx(start.tolist(), abs=1e-6)
    assert walk.interior(paths.state[0]).all()
    assert torch.equal(paths.reached, walk.reached(paths.state[-1]))


def test_rollouts_are_drawn_to_their_ends(measured):
    axes = draw(measured)["rollouts"].axes[0]
    paths, markers = [], []
    for line in axes.lines:
        (paths if line.get_marker() == "None" else markers).append(line.get_xydata())
    assert [len(path) for path in paths] == (measured.paths.steps + 1).tolist()
    ends = np.array([path[-1] for path in paths])
    assert np.array([marker[0] for marker in markers[1::2]]) == pytest.approx(ends)


def test_a_problem_with_one_state_has_nothing_to_show():
    solution = Known(Reach1D())
    for evaluator in (Slices(3, 1), Rollouts(1, 3)):
        evidence = evaluator(solution, Simulator(solution.problem))
        assert evidence.metrics() == {}
        assert draw(evidence) == {}


def test_evidence_is_among_the_figures_of_a_run(tmp_path):
    solution = Known(Walk())
    simulator = Simulator(solution.problem, dt=0.1, substeps=10, crossing="endpoint")
    evidence = evaluate(solution, simulator, {"slices": Slices(5, 2), "rollouts": Rollouts(2, 5)})
    paths = draw_run(solution, tmp_path / "none.csv", tmp_path / "figures", evidence)
    assert [path.name for path in paths] == ["slice_walk_angle.png", "policy_walk_angle.png", "rollouts.png"]
    assert all(imread(path)[..., :3].std() > 0.01 for path in paths)


def test_arrows_are_drawn_outside_the_sets_alone():
    solution = Known(Walk())
    simulator = Simulator(solution.problem, dt=0.1, substeps=10, crossing="endpoint")
    evidence = evaluate(solution, simulator, {"slices": Slices(11, 2)})
    left = draw(evidence["slices"])["slice_walk_angle"].axes[0]
    (arrows,) = [artist for artist in left.collections if isinstance(artist, Quiver)]
    shown = ~arrows.Umask
    assert (shown == (arrows.X < 2)).all()
    assert shown.any()
    assert not shown.all()


def test_every_metric_of_the_drifting_problem_has_a_meaning():
    problem = VehicleDrift()
    meanings = Slices(31, 64).meanings(problem)
    assert list(problem.planes) == ["beta_r", "e_y_e_psi"]
    assert set(meanings) == {f"slice_{plane}_{name}" for plane in problem.planes for name in ("tau", "mae", "success")}
    assert "31 x 31 grid of the plane beta_r" in meanings["slice_beta_r_mae"]
    assert Rollouts().meanings(problem) == Slices().meanings(Reach1D()) == {}


@pytest.mark.parametrize(
    ("kind", "arguments"), [(Slices, {"points": 1}), (Slices, {"rollouts": 0}), (Rollouts, {"paths": 0})]
)
def test_wrong_sizes_are_refused(kind, arguments):
    with pytest.raises(ValueError, match=f"{kind.__name__}.*{next(iter(arguments))}"):
        kind(**arguments)
