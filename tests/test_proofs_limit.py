"""Upper bounds for every policy: they are above exact probabilities, and no control violates their inequality."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from scipy.interpolate import NdBSpline
from torch import Tensor

from pirl_rl import certify, load_run
from pirl_rl.errors import ProofError
from pirl_rl.grid import GridSolver
from pirl_rl.payoffs import SmoothPayoff
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import DoubleIntegrator, DubinsCar, Exit1D, HalfSpace, Pendulum, Reach1D, Safety1D
from pirl_rl.proofs import LowerBound, Settings, UpperBound, prove_limit
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.conditions import Conditions
from pirl_rl.proofs.ends import Ends
from pirl_rl.proofs.faces import face_points, smooth_avoid, smooth_target
from pirl_rl.proofs.mesh import mesh_of, product
from pirl_rl.proofs.polynomials import TaylorModel
from pirl_rl.proofs.search import prove
from pirl_rl.proofs.spline import Spline, knots_of
from pirl_rl.sets import Box

ROUNDING = 1e-9
"""What the inequality may lack at a point by rounding, in 1/s."""


class Turned(Reach1D):
    """Reach1D with the drift sin(u): the best one is 1 too, so that V is the same, but it is not affine in u."""

    controls = Box([-2.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u.sin()


class Noisy(Reach1D):
    """Reach1D with a noise that grows with the control, the square of which is in the generator."""

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.8 + 0.2 * u).unsqueeze(-1)


def generator(problem: ReachAvoidProblem, spline: Spline, tau: Tensor, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """W (N,) and L^u W (N,) by another library's splines."""
    points, n = torch.column_stack([tau, x]).numpy(), x.shape[1]
    w = NdBSpline(tuple(map(knots_of, spline.edges)), spline.coefficients.numpy(), 3)

    def derivative(*axes: int) -> Tensor:
        return torch.from_numpy(w(points, nu=tuple(axes.count(j) for j in range(n + 1))))

    f, sigma = problem.drift(x, u), problem.diffusion(x, u)
    a = sigma @ sigma.mT
    result = -derivative(0) + sum(f[:, i] * derivative(1 + i) for i in range(n))
    for i in range(n):
        for j in range(n):
            result += 0.5 * a[:, i, j] * derivative(1 + i, 1 + j)
    return derivative(), result


def sampled(problem: ReachAvoidProblem, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Times to go, states outside A and B, and controls, half of them at ends of their ranges."""
    rng = torch.Generator().manual_seed(seed)
    x = problem.states.sample(count, rng, torch.float64)
    x = x[problem.interior(x)]
    tau = problem.horizon * torch.rand(len(x), generator=rng, dtype=torch.float64)
    u = problem.controls.normalize(problem.controls.sample(len(x), rng, torch.float64))
    u[::2] = u[::2].sign()
    return tau, x, problem.controls.denormalize(u)


def assert_no_control_violates(limit: UpperBound, count: int) -> None:
    """L^u W >= 0 at sampled states and controls where W - margin > 0."""
    w, residual = generator(limit.problem, limit.spline, *sampled(limit.problem, count, 5))
    asked = w > limit.margin
    assert asked.double().mean() > 0.1
    assert residual[asked].min() >= -ROUNDING


@pytest.mark.parametrize(
    ("problem", "cells", "near"), [(Reach1D(), 64, 0.06), (Exit1D(), 64, 0.06), (Turned(), 16, 0.2)]
)
def test_an_upper_bound_is_above_the_exact_probability_and_near(problem, cells, near):
    """At all of 20,000 points, and in the middle not far above."""
    limit = prove_limit(problem, Settings(cells=cells, steps=cells))
    assert limit.holds
    assert not limit.resisted
    tau, x, _ = sampled(problem, 20_000, 0)
    assert (limit.bound(tau.numpy(), x.numpy()) >= problem.exact_value(tau, x).numpy()).all()
    middle = limit.bound(np.array([problem.horizon]), np.zeros((1, 1)))[0]
    known = problem.exact_value(torch.tensor([problem.horizon]), torch.zeros(1, 1)).item()
    assert known < middle < known + near
    assert_no_control_violates(limit, 1_000_000)


def test_a_smoothed_payoff_leaves_the_limit_as_it_is():
    """States in A that are not in A_eps succeed, so that nothing is said of them."""
    settings = Settings(cells=16, steps=16)
    limit, hard = (prove_limit(problem, settings) for problem in (Reach1D(payoff=SmoothPayoff(0.3)), Reach1D()))
    assert limit.to_dict() | {"seconds": 0} == hard.to_dict() | {"seconds": 0}


def test_an_invariance_problem_has_an_upper_bound():
    """A grid of 401 nodes, whose error is below 0.002, gives 0.400 in the middle."""
    problem = Safety1D()
    limit, grid = prove_limit(problem), GridSolver(problem, estimate=False).solve()
    tau, x, _ = sampled(problem, 5_000, 1)
    above = limit.bound(tau.numpy(), x.numpy()) - grid.value(tau, x).numpy()
    assert above.min() > -0.002
    assert limit.bound(np.array([2.0]), np.zeros((1, 1)))[0] < 0.46
    assert_no_control_violates(limit, 1_000_000)


def random_spline(problem: ReachAvoidProblem, seed: int) -> Spline:
    edges = mesh_of(Ends(problem, success=False), 8, 8).edges
    return Spline(edges, np.random.default_rng(seed).normal(size=[len(axis) + 2 for axis in edges]))


def everything(problem: ReachAvoidProblem, spline: Spline) -> tuple[Conditions, Boxes]:
    """The conditions for all controls of some W, and the boxes of all cells and controls."""
    first = 1 + problem.states.dim
    conditions = Conditions(Ends(problem, success=False), lambda z: z[:, first:], spline, 0.01)
    controls = [np.array(ends) for ends in zip(problem.controls.low, problem.controls.high, strict=True)]
    return conditions, Boxes.cells([*spline.edges, *controls])


@pytest.mark.parametrize("problem", [Reach1D(), Turned(), Noisy(), Pendulum(), HalfSpace(dim=2), DoubleIntegrator()])
def test_the_least_residual_over_all_controls_is_enclosed(problem):
    """Of random W, whose slopes have both signs in many boxes, at random states and controls of all boxes."""
    spline, rng = random_spline(problem, 0), torch.Generator().manual_seed(1)
    conditions, boxes = everything(problem, spline)
    boxes = boxes.halves(torch.arange(len(boxes)) % boxes.cell.shape[1])
    low, n = conditions.residual(boxes), 1 + problem.states.dim
    tight = torch.full((len(boxes),), torch.inf, dtype=torch.float64)
    for k in range(12):
        e = (2 * torch.rand(boxes.share.shape, generator=rng, dtype=torch.float64) - 1) * (1 - 1e-9)
        e = e.sign() * (1 - 1e-9) if k % 3 == 0 else e
        z = boxes.centre + boxes.half_width * e
        _, residual = generator(problem, spline, z[:, 0], z[:, 1:n], z[:, n:])
        assert (residual >= low - 1e-9 * residual.abs().max()).all()
        tight = torch.minimum(tight, residual)
    assert torch.isfinite(low).all()


def test_a_function_that_keeps_its_sign_has_the_exact_negative_absolute_value():
    powers = torch.tensor([[2.0, 0.5], [-2.0, 0.5], [0.1, 1.0]], dtype=torch.float64)
    below, undecided = TaylorModel(powers, torch.zeros(3, dtype=torch.float64)).minus_absolute()
    assert undecided.tolist() == [False, False, True]
    assert below.powers[:2].numpy() == pytest.approx(np.array([[-2.0, -0.5], [-2.0, 0.5]]))
    e = torch.linspace(-1, 1, 101, dtype=torch.float64)
    value, line = 0.1 + e, below.powers[2, 0] + below.powers[2, 1] * e
    assert (line - below.remainder[2] <= -value.abs()).all()
    # The chord of |g| between g = -0.9 and g = 1.1 touches at both ends.
    assert line[[0, -1]].numpy() == pytest.approx([-0.9, -1.1])


def test_a_spoilt_bound_is_not_proved():
    """A bump of 0.001 in the middle of a proved W, which is curved too much on its flanks, and a W that is raised."""
    limit = prove_limit(Reach1D())
    conditions, boxes = everything(limit.problem, limit.spline)
    assert prove(conditions.interior, boxes, 0.01, 10, 100_000).proved
    spoilt = limit.spline.coefficients.clone()
    spoilt[30, 40] += 1e-3
    conditions, boxes = everything(limit.problem, Spline(limit.spline.edges, spoilt))
    outcome = prove(conditions.interior, boxes, 0.01, 10, 100_000)
    assert not outcome.proved
    assert outcome.margin > 0.1
    conditions, boxes = everything(limit.problem, Spline(limit.spline.edges, limit.spline.coefficients + 0.05))
    outcome = prove(conditions.start, boxes.at_end(0, 0, -1), 0.01, 10, 100_000)
    assert outcome.margin > 0.04


def test_a_bound_takes_what_its_conditions_lack():
    """On a mesh that is too coarse conditions fail, and the bound rises until it is proved."""
    limit = prove_limit(Reach1D(), Settings(cells=8, steps=8, rounds=1, halvings=0))
    assert "interior" in limit.resisted
    tau, x, _ = sampled(Reach1D(), 1_000, 2)
    assert (limit.bound(tau.numpy(), x.numpy()) >= Reach1D().exact_value(tau, x).numpy()).all()


class Narrow(DoubleIntegrator):
    tolerance = 0.004


def test_sets_without_corners_are_on_the_safe_side():
    """W is 0 on the face of a set around A, which may be thinner than the mesh, and 1 on that of a set in B."""
    for problem in (DoubleIntegrator(), Narrow()):
        ends = Ends(problem, success=False)
        mesh = mesh_of(ends, 40, 10)
        x = product(mesh.points([0.5]))
        inside = (2 * torch.rand(500, 2, dtype=torch.float64) - 1) * problem.tolerance
        level = smooth_target(ends, torch.from_numpy(x))
        assert (level(inside) <= 0).all()
        assert level(torch.tensor([[2 * problem.tolerance, 0.0]], dtype=torch.float64)) > 0
    points = torch.from_numpy(face_points(smooth_avoid(ends, mesh, torch.from_numpy(x)), mesh, x))
    assert len(points) > 100
    assert problem.avoid_level(points).max() < 1e-9
    assert problem.avoid_level(points).min() > -0.15


def test_a_file_is_read_for_its_problem_alone(tmp_path):
    """Nothing in it depends on networks; another noise, horizon or target is another problem."""
    limit, path = prove_limit(Reach1D()), tmp_path / "limit.npz"
    limit.save(path)
    points = np.full(3, 1.5), np.array([[-1.0], [0.0], [1.0]])
    assert (UpperBound.load(path, Reach1D()).bound(*points) == limit.bound(*points)).all()
    for other in (Turned(), Noisy(), Reach1D(horizon=1.0), Exit1D(), Safety1D()):
        with pytest.raises(ProofError, match="it proves something about a problem with other drift, noise"):
            UpperBound.load(path, other)
    with pytest.raises(ProofError, match="expected a file of `certify method=interval`"):
        LowerBound.load(path, Reach1D(), "none")


@pytest.mark.parametrize(
    ("problem", "message"), [(HalfSpace(dim=4), "at most 3 states, got 4"), (DubinsCar(), "no periodic coordinates")]
)
def test_problems_beyond_the_method_are_refused(problem, message):
    with pytest.raises(ProofError, match=message):
        prove_limit(problem)


def test_the_command_proves_both_bounds(trained, in_process):
    """The policy, its V and the exact one lie below the limit, which stays when the networks change."""
    code, text = in_process(certify)(
        f"run={trained}", "method=interval", "bounds=[lower,upper]", "cells=40", "steps=40"
    )
    assert code == 0, text
    found = json.loads((trained / "limit.json").read_text())
    assert found["holds"], found
    assert "networks" not in found
    assert f"with a probability above {found['lowest']:.4f}" in text
    assert "The bound does not depend on the networks." in text
    run = load_run(trained)
    lower, limit = run.load_proof(trained / "proof.npz"), run.load_limit(trained / "limit.npz")
    assert f"within {limit.gap(lower):.4f} of the best one" in text
    tau, x, _ = sampled(run.problem, 1_000, 3)
    points = tau.numpy(), x.numpy()
    assert (lower.bound(*points) <= limit.bound(*points)).all()
    assert limit.bound(np.array([run.problem.horizon]), np.array([found["lowest_state"]]))[0] == found["lowest"]
    with torch.no_grad():
        next(run.solution.actor.parameters()).add_(1e-6)
    assert (run.load_limit(trained / "limit.npz").bound(*points) == limit.bound(*points)).all()
    assert (trained / "figures" / "proof.png").stat().st_size > 10_000


@pytest.mark.parametrize("value", ["upper", "[]", "[upper,best]"])
def test_wrong_bounds_are_one_sentence(value, trained, in_process):
    code, text = in_process(certify)(f"run={trained}", "method=interval", f"bounds={value}")
    assert code == 1
    assert "Traceback" not in text
    assert "bounds: expected a list of lower and upper, got" in text


@pytest.mark.slow
@pytest.mark.parametrize("settings", [Settings(), Settings(cells=32, steps=30)])
def test_two_states_have_an_upper_bound(settings):
    """It is above V of a grid, whose error is below 0.03, and no control violates it."""
    problem = Pendulum()
    limit = prove_limit(problem, settings)
    assert limit.holds
    assert not limit.resisted
    tau, x, _ = sampled(problem, 2_000, 4)
    value = GridSolver(problem, estimate=False).solve().value(tau, x)
    assert (limit.bound(tau.numpy(), x.numpy()) >= value.numpy() - 0.03).all()
    assert_no_control_violates(limit, 300_000)
