"""How a report states a problem: equations found by probing, names, pictures of the sets; and curves of a training."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from test_planes import Known

from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.errors import ProblemError
from pirl_rl.evaluation.planes import coordinate_plane
from pirl_rl.problems import CartPole, DoubleIntegrator, HalfSpace, PlanarQuadrotor, Reach1D, VehicleDrift, ZermeloBoat
from pirl_rl.reports.curves import MOST_POINTS, training_curves
from pirl_rl.reports.equations import MOST_ROWS, equations
from pirl_rl.reports.maps import MOST_SLIDERS, plane_maps
from pirl_rl.reports.names import as_html, as_mathml, control_names, split_unit, state_names
from pirl_rl.reports.outlines import outlines
from pirl_rl.reports.statement import Statement
from pirl_rl.structure import check_problem


def plain(equation: str) -> str:
    """An equation of MathML as plain text, with indices after an underscore."""
    text = re.sub(r"<msub>(.*?)</m[in]><m[in]>", r"\1_", str(equation))
    text = re.sub(r"<msup><mn>10</mn><mn>", "10^", text)
    return re.sub(r"<[^>]*>", "", text)


class Mixed(ReachAvoidProblem):
    """Rows with a constant, a product, noise that depends on the state, and nothing at all."""

    horizon = 1.0
    states, controls = Box([-2.0] * 4, [2.0] * 4), Box([-1.0], [3.0])

    def drift(self, x, u):
        rows = [2.5 - 0.5 * x[..., 1] - u[..., 0], x[..., 0] * u[..., 0], 3e7 * x[..., 3], torch.zeros_like(x[..., 0])]
        return torch.stack(rows, -1)

    def diffusion(self, x, u):
        sigma = torch.zeros(*x.shape, 2, dtype=x.dtype)
        sigma[..., 0, 0], sigma[..., 0, 1], sigma[..., 2, 1] = 0.25, -1.0, x[..., 0]
        return sigma

    def target_level(self, x):
        return x[..., 0] - 1


@pytest.mark.parametrize(
    ("problem", "wanted"),
    [
        (Reach1D(), ["dx=udt+dW"]),
        (DoubleIntegrator(), ["dp=vdt+0.2dW_1", "dv=udt+0.4dW_2"]),
        (ZermeloBoat(), ["dx_1=f_1(x_2,u_1)dt+0.3dW_1", "dx_2=u_2dt+0.3dW_2"]),
        (
            Mixed(),
            [
                "dx_1=(−0.5x_2−u+2.5)dt+0.25dW_1−dW_2",
                "dx_2=f_2(x_1,u)dt",
                "dx_3=3·10^7x_4dt+σ_3(x,u)dW",
                "dx_4=0",
            ],
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_equations_are_those_of_the_code(problem, wanted):
    assert [plain(row) for row in equations(problem)] == wanted


def test_equations_of_the_quadrotor_and_of_many_states():
    rows = [plain(row) for row in equations(PlanarQuadrotor())]
    assert rows[0] == "dx=x′dt"
    assert rows[4] == "dz′=f_5(θ,u_1,u_2)dt+0.5dW_2"
    turn = 0.25 / 0.00383  # the arm over the inertia
    assert rows[5] == f"dθ′=({turn:.4g}u_1−{turn:.4g}u_2)dt+dW_3"
    assert len(equations(HalfSpace(dim=40))) == MOST_ROWS
    assert len(Statement.of(HalfSpace(dim=40), {}).controls) == MOST_ROWS


def test_names():
    assert state_names(HalfSpace(dim=2)) == ["x_1", "x_2"]
    assert control_names(Reach1D()) == ["u"]
    assert state_names(VehicleDrift())[1] == "e_psi (rad)"
    assert split_unit("sideslip beta (rad)") == ("sideslip beta", "rad")
    assert split_unit("mu") == ("mu", "")
    assert as_html("e_psi (m/s^2)") == "e<sub>ψ</sub> (m/s<sup>2</sup>)"
    assert as_html("$x_{1}$ <b>&") == "x<sub>1</sub> &lt;b&gt;&amp;"
    assert as_html("lambda thetaed delta'") == "λ thetaed δ′"
    assert as_mathml("v_x") == "<msub><mi>v</mi><mi>x</mi></msub>"
    assert as_mathml("<i>") == "<mtext>&lt;i&gt;</mtext>"


@pytest.mark.parametrize("names", ["ab", ("a",), ("a", 2)])
def test_names_must_be_as_many_as_the_coordinates(names):
    problem = DoubleIntegrator()
    problem.state_names = names
    with pytest.raises(ProblemError, match=r"DoubleIntegrator.state_names: expected 2 names"):
        check_problem(problem)


class Large(ZermeloBoat):
    """Levels in units of 2^-40 m, so that a thousandth of a meter is a large number."""

    def target_level(self, x):
        return 2.0**40 * super().target_level(x)

    def avoid_constraints(self, x):
        return 2.0**40 * super().avoid_constraints(x)


def test_pictures_show_the_sets_in_their_places():
    """The landing is the disc around (1.4, 0.4) with radius 0.3 m; the picture is 1.25 times as wide as the box."""
    [picture] = outlines(ZermeloBoat(), ZermeloBoat().planes)
    corners = np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", picture["paths"]["target"]), float)
    x = -2.5 + 5.0 * corners[:, 0] / picture["width"]
    y = -1.25 + 2.5 * (1 - corners[:, 1] / picture["height"])
    assert np.abs(np.hypot(x - 1.4, y - 0.4) - 0.3).max() < 0.005
    assert picture["width"] / picture["height"] == 2  # both axes have the same scale
    [other] = outlines(Large(), ZermeloBoat().planes)
    assert other["paths"] == picture["paths"]
    [line] = outlines(Reach1D(), {})
    ends = sorted({float(x) for x, _ in re.findall(r"(-?[\d.]+) (-?[\d.]+)", line["paths"]["target"])})
    assert -2.5 + 5.0 * ends[0] / line["width"] == pytest.approx(2.0, abs=0.01)
    assert "avoid" not in line["paths"]
    assert {*outlines(CartPole(), CartPole().planes)[0]["paths"]} == {"avoid"}


def test_of_many_coordinates_those_in_which_v_varies_most_have_a_slider():
    """The entries of the normal are in the ratios 1 : -2 : 3 : -1 : 2 : -3 : 1 : -2 : 3 : -1."""
    problem = HalfSpace(dim=10)
    plane = coordinate_plane(problem, 0, 1, torch.zeros(10, dtype=torch.float64))
    [found] = plane_maps(Known(problem), {"first": plane}, 10**5)
    assert [entry["label"] for entry in found["further"]] == [f"x<sub>{i}</sub>" for i in (3, 5, 6, 8, 9)]
    assert found["left_out"] == 8 - MOST_SLIDERS == 3
    assert all(entry["values"][entry["start"]] == 0.0 for entry in found["further"])


def test_curves_keep_their_ends_and_skip_empty_cells():
    updates = np.arange(0.0, 5_000.0)
    rate = np.where(updates % 2 == 0, 1 / (1 + updates), np.nan)
    curves = training_curves({"update": updates, "train_td_loss": rate, "stage": (updates > 2_000).astype(float)})
    [panel] = curves["panels"]
    [curve] = panel["curves"]
    assert panel["log"]
    assert MOST_POINTS / 2 < len(curve["x"]) <= MOST_POINTS + 1
    assert (curve["x"][0], curve["x"][-1]) == (0, 4_998)
    assert curve["y"][-1] == rate[4_998]
    assert curves["stages"] == [2_001]
    assert training_curves({}) == {"panels": [], "stages": []}
