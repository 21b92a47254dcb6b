"""Default planes, and reliability diagrams in bins of equally many states."""

import math

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from pirl_rl.evaluation import Calibration, Slices, meanings_of
from pirl_rl.evaluation.planes import coordinate_plane, plane_names, planes_of
from pirl_rl.evaluation.slices import Section
from pirl_rl.figures import draw
from pirl_rl.figures.planes import draw_plane
from pirl_rl.figures.reliability import draw_reliability
from pirl_rl.problems import DubinsCar, HalfSpace, Pendulum, Reach1D, ZermeloBoat
from pirl_rl.sets import Box, Plane
from pirl_rl.simulator import Simulator


class Plain(HalfSpace):
    """The half-space in five dimensions without planes of its own; V varies most along the third and the sixth axis."""

    planes = {}

    def __init__(self):
        super().__init__(dim=6)


class TwoStates(Pendulum):
    planes = {}


class Known:
    """Stands for a `Solution`: the exact value and the optimal control."""

    dtype, device = torch.float32, torch.device("cpu")

    def __init__(self, problem):
        self.problem, self.policy = problem, problem.optimal_control
        self.value = self.raw_value = problem.exact_value

    def gradient(self, tau, x):
        return torch.func.grad(lambda y: self.problem.exact_value(tau, y).sum())(x)


def test_the_names_depend_on_the_number_of_states():
    assert plane_names(Reach1D()) == ()
    assert plane_names(TwoStates()) == ("states",)
    assert plane_names(Plain()) == ("first", "steepest")
    assert plane_names(ZermeloBoat()) == tuple(ZermeloBoat().planes)


def test_the_steepest_plane_shows_the_coordinates_with_the_largest_slopes():
    """The normal has the ratios 1 : -2 : 3 : -1 : 2 : -3."""
    planes = planes_of(Known(Plain()))
    assert [plane.axes for plane in planes.values()] == [("$x_{1}$", "$x_{2}$"), ("$x_{3}$", "$x_{6}$")]


def test_default_planes_go_through_the_target_near_the_centre():
    problem = Plain()
    for plane in planes_of(Known(problem)).values():
        points = plane.box.sample(100, torch.Generator().manual_seed(0), torch.float64)
        x = plane.embed(points)
        assert torch.equal(plane.project(x), points)
        others = [i for i in range(6) if len(x[:, i].unique()) == 1]
        assert len(others) == 4
        # The nearest point of the half-space to the centre has a . x = 1, so that its distance is 1.
        assert x[0, others].norm() < 1.5


def test_a_plane_of_a_periodic_coordinate_is_periodic():
    problem = DubinsCar()
    plane = coordinate_plane(problem, 0, 2, torch.zeros(3, dtype=torch.float64))
    assert plane.box.periodic == (1,)
    assert plane.box.high[1] - plane.box.low[1] == pytest.approx(2 * math.pi)


def test_a_section_shows_both_sets_and_the_policy():
    problem = Plain()
    simulator = Simulator(problem, 0.1)
    evidence = Slices(points=5, rollouts=2)(Known(problem), simulator)
    assert {*evidence.metrics()} == {*meanings_of({"slices": Slices(points=5, rollouts=2)}, problem)["slices"]}
    cut = evidence.slices["steepest"]
    assert cut.action.shape == (5, 5, 6)
    assert torch.allclose(cut.action[0, 0], torch.tensor(problem.normal).sign())
    assert not cut.section.failed.any()
    # Along the normal the target fills the part of the plane where a . x >= 1.
    fine = Section.of(Known(problem), cut.section.plane, 151, cut.section.time)  # type: ignore[arg-type]
    assert torch.equal(cut.section.reached.flatten(), problem.reached(fine.x.double()).flatten())
    figures = draw(evidence)
    assert {*figures} == {"slice_first", "slice_steepest", "policy_first", "policy_steepest"}
    assert len(figures["policy_first"].axes) == 4  # three of six controls, and the scale


@pytest.mark.parametrize(("width", "factor"), [(3.0, ""), (3e5, "1e5"), (3e-5, "1e−5")])
def test_labels_of_very_large_and_very_small_ticks_have_a_common_factor(width, factor):
    plane = Plane(("a", "b"), Box([-width, -1.0], [width, 1.0]), lambda points: points, lambda x: x)
    axis, none = torch.linspace(-1, 1, 3), torch.zeros(9, 9, dtype=torch.bool)
    cut = Section(plane, (width * axis, axis), torch.ones(9), torch.zeros(9, 2), torch.rand(3, 3), none, none)
    figure = Figure()
    axes = figure.subplots()
    draw_plane(axes, cut, cut.value)
    figure.draw_without_rendering()
    assert axes.xaxis.get_offset_text().get_text() == factor
    assert not axes.yaxis.get_offset_text().get_text()


def test_bins_of_a_reliability_diagram_hold_equally_many_states():
    """Of 100 states, 90 with V = 0 and success 0, the others with V = 0.5 and success 0.25."""
    value = np.repeat([0.0, 0.5], [90, 10])
    axes = Figure().subplots()
    draw_reliability(axes, value, {"paths": value / 2})
    points = axes.containers[0].lines[0].get_xydata()  # type: ignore[union-attr]
    assert points.tolist() == [[0.0, 0.0]] * 4 + [pytest.approx([0.25, 0.125])]


def test_calibration_is_drawn():
    problem = Reach1D()
    evidence = Calibration(points=64, rollouts=16)(Known(problem), Simulator(problem, 0.05))  # type: ignore[arg-type]
    figure = draw(evidence)["calibration"]
    assert f"{evidence.metrics()['calibration_mae']:.4f}" in figure.axes[1].get_title()
