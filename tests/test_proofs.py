"""Proofs: enclosures contain what they enclose, and proved bounds are below exact probabilities."""

from __future__ import annotations

import copy
import json
import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
import torch
from scipy.interpolate import NdBSpline
from torch import nn

from pirl_rl import certify, load_run
from pirl_rl.certificates import Deployed
from pirl_rl.errors import ProofError
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.grid import GridSolver
from pirl_rl.networks import Actor
from pirl_rl.payoffs import LipschitzPayoff
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import (
    DoubleIntegrator,
    DubinsCar,
    Exit1D,
    HalfSpace,
    Pendulum,
    Reach1D,
    Safety1D,
    ZermeloBoat,
)
from pirl_rl.proofs import LowerBound, Settings, prove_success
from pirl_rl.proofs.affine import Affine
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.ends import Ends
from pirl_rl.proofs.faces import face_points, smooth_target
from pirl_rl.proofs.mesh import mesh_of, product
from pirl_rl.proofs.normal import NormalEquations
from pirl_rl.proofs.points import Lattice, Points
from pirl_rl.proofs.polynomials import TaylorModel
from pirl_rl.proofs.search import prove
from pirl_rl.proofs.spline import Spline, design, knots_of
from pirl_rl.sets import Box

MATRIX = torch.tensor([[0.5, -1.0], [2.0, 0.25]], dtype=torch.float64)

FUNCTIONS = {
    "abs": lambda z: z.abs(),
    "abs of Python": lambda z: abs(z - 0.2),
    "atan": torch.atan,
    "cos": torch.cos,
    "exp": torch.exp,
    "log": lambda z: torch.log(z + 4),
    "sigmoid": torch.sigmoid,
    "silu": nn.SiLU(),
    "sin": lambda z: z.sin(),
    "softplus": nn.Softplus(),
    "sqrt": lambda z: torch.sqrt(z + 4),
    "square": lambda z: z**2,
    "cube": lambda z: z**3,
    "tan": lambda z: torch.tan(z / 3),
    "tanh": nn.Tanh(),
    "reciprocal": lambda z: 1 / (z + 4),
    "negative reciprocal": lambda z: 2.0 / (z - 4),
    "relu": lambda z: torch.relu(z),
    "clamp": lambda z: z.clamp(-0.5, 0.7),
    "product": lambda z: z * z.sin() - 3 * z,
    "cancellation": lambda z: (1 + z) - z,
    "norm": lambda z: torch.stack([z, 2 * z + 1], -1).norm(dim=-1),
    "maximum": lambda z: torch.maximum(z, -z * z),
    "row times matrix": lambda z: (torch.stack([z, z.sin()], -1) @ MATRIX)[..., 1],
    "row times vector": lambda z: torch.stack([z, z.sin()], -1) @ MATRIX[0],
    "matrix times column": lambda z: (MATRIX @ torch.stack([z, z.sin()], -1).unsqueeze(-1))[..., 1, 0],
    "where": lambda z: torch.where(z > 0.3, z.sin(), 2 - z),
    "where of numbers": lambda z: torch.where((z > -1) & ~(z >= 0.5) | (z > 2), 1.0, -0.5),
    "indicator": lambda z: z * (z < 0.3) + torch.sign(z),
    "root": lambda z: (z + 4) ** 0.5 - z**2.0,
    "numbers of numpy": lambda z: np.float64(2) * z - z / np.float64(3),
    "vector norm": lambda z: torch.linalg.vector_norm(torch.stack([z, 2 * z + 1], -1), dim=-1),
}


def random_boxes(count: int, dim: int, size: float, rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Centres and halves of sides (count, dim) of boxes within [-3, 3]^dim."""
    half = size * torch.rand(count, dim, generator=rng, dtype=torch.float64)
    return (2 * torch.rand(count, dim, generator=rng, dtype=torch.float64) - 1) * (3 - half), half


def assert_encloses(form: Affine, function, centre: torch.Tensor, half: torch.Tensor, rng: torch.Generator) -> None:
    """Values at random points of the boxes and at their corners are within the form, and within its bounds."""
    for k in range(12):
        e = 2 * torch.rand(centre.shape, generator=rng, dtype=torch.float64) - 1
        e = e.sign() if k % 3 == 0 else e
        value = function(centre + half * e)
        line = form.centre + torch.einsum("dn...,nd->n...", form.slopes, e)
        assert (value >= form.low).all()
        assert (value <= form.high).all()
        assert ((value - line).abs() <= form.radius + 1e-14 * form.magnitude).all()


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("size", [1.0, 0.01])
def test_a_function_of_a_box_is_enclosed(name, size):
    rng = torch.Generator().manual_seed(0)
    centre, half = random_boxes(300, 1, size, rng)

    def function(x):
        return FUNCTIONS[name](x[:, 0])

    assert_encloses(function(Affine.of_box(centre, half)), function, centre, half, rng)


PRECISE = {
    "exp": lambda z: z.exp(),
    "sigmoid": lambda z: 1 / (1 + (-z).exp()),
    "silu": lambda z: z / (1 + (-z).exp()),
    "softplus": lambda z: (1 + z.exp()).ln(),
    "square": lambda z: z * z,
    "tanh": lambda z: 1 - 2 / (1 + (2 * z).exp()),
}


@pytest.mark.parametrize("name", PRECISE)
def test_an_enclosure_has_room_for_its_rounding(name):
    """With 60 digits, in boxes of many sizes, and where functions are nearly straight."""
    rng, count = torch.Generator().manual_seed(7), 600
    centre = 45 * (2 * torch.rand(count, 1, generator=rng, dtype=torch.float64) - 1)
    centre[::10] = 0.0
    half = 10 ** (1 - 15 * torch.rand(count, 1, generator=rng, dtype=torch.float64))
    form = FUNCTIONS[name](Affine.of_box(centre, half)[:, 0])
    rows = torch.stack([centre[:, 0], half[:, 0], form.centre, form.slopes[0], form.radius, form.low, form.high], -1)
    with localcontext(prec=60):
        for row in rows.tolist():
            c, h, middle, slope, radius, low, high = map(Decimal, row)
            for e in map(Decimal, (-1, 0, 1)):
                value = PRECISE[name](c + h * e)
                assert low <= value <= high, row
                assert abs(value - middle - slope * e) <= radius, row


@pytest.mark.parametrize("name", ["silu", "tanh", "sin", "exp", "product", "sqrt"])
def test_an_enclosure_is_wrong_by_the_square_of_the_size(name):
    rng = torch.Generator().manual_seed(1)
    centre, half = random_boxes(200, 1, 0.02, rng)
    wide, narrow = (FUNCTIONS[name](Affine.of_box(centre, h)[:, 0]).radius.mean() for h in (half, half / 10))
    assert wide / narrow > 80


@pytest.mark.parametrize("problem", [Reach1D(), Pendulum(), DoubleIntegrator(), ZermeloBoat(), DubinsCar()])
def test_a_policy_and_the_physics_are_enclosed(problem):
    """Drift, noise and the levels of the sets under a network with all features of the default recipe."""
    torch.manual_seed(0)
    actor = Actor(problem, hidden=(16, 16), activation="SiLU", root_time=True, spread=3.0, levels=True).double()
    rng = torch.Generator().manual_seed(2)
    low = torch.tensor([0.0, *problem.states.low], dtype=torch.float64)
    width = torch.tensor([problem.horizon, *problem.states.high], dtype=torch.float64) - low
    half = 0.01 * width * torch.rand(100, len(width), generator=rng, dtype=torch.float64)
    centre = low + half + (width - 2 * half) * torch.rand(100, len(width), generator=rng, dtype=torch.float64)

    @torch.no_grad()
    def rates(z):
        x = z[:, 1:]
        u = problem.controls.denormalize(actor(z[:, :1], x))
        parts = [u, problem.drift(x, u)]
        parts += [problem.reached_constraints(x)] if problem.objective == "reach-avoid" else []
        return torch.cat(parts + ([problem.avoid_constraints(x)] if problem.has_avoid_set else []), -1)

    assert_encloses(rates(Affine.of_box(centre, half)), rates, centre, half, rng)


def test_a_number_stands_in_for_a_form_of_several_coordinates():
    rng = torch.Generator().manual_seed(6)
    centre, half = random_boxes(300, 2, 1.0, rng)
    chosen = torch.rand(300, 1, generator=rng) < 0.5

    def function(z):
        return torch.where(chosen, z[:, :1], 0.5) + torch.where(z[:, 1:] > z[:, :1], 1.0, 0.0)

    form = function(Affine.of_box(centre, half))
    assert form.slopes.shape == (2, 300, 1)
    assert_encloses(form, function, centre, half, rng)


def test_an_unknown_function_is_refused():
    form = Affine.of_box(torch.zeros(1, 1, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64))
    with pytest.raises(ProofError, match=r"torch\.erf: no enclosure"):
        torch.erf(form)
    with pytest.raises(ProofError, match="sqrt: its argument is not positive"):
        form.sqrt()


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (lambda z: z * (z == 0), "torch.eq"),
        (lambda z: z % 1.0, "torch.mod"),
        (lambda z: 2.0**z, "torch.rpow"),
        (lambda z: z.T, "torch.T"),
        (lambda z: torch.add(z, z, alpha=2), "torch.add"),
        (lambda z: z.sum(axis=-1), "torch.sum"),
        (lambda z: z.__setitem__(0, 1.0), "torch.setitem"),
        (lambda z: torch.zeros(1).__setitem__(0, z), "torch.setitem"),
        (lambda z: torch.sin(z) if z > 0 else z, "if"),
        (lambda z: z.add_(1.0), "torch.add_"),
        (lambda z: [*z], "torch.iter"),
        (lambda z: np.arcsin(z), "torch.arcsin"),
    ],
)
def test_an_operation_without_an_enclosure_is_named(function, name):
    form = Affine.of_box(torch.zeros(1, 1, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64))
    with pytest.raises(ProofError, match=rf"^{name}: .*enclosure"):
        function(form)


def random_spline(seed: int) -> tuple[Spline, NdBSpline]:
    """A spline of three coordinates, and the same of another library."""
    rng = np.random.default_rng(seed)
    edges = [np.linspace(0, 2, 7) ** 1.5, np.linspace(-2, 2, 9), np.linspace(-1, 1, 5)]
    coefficients = rng.normal(size=[len(axis) + 2 for axis in edges])
    return Spline(edges, coefficients), NdBSpline(tuple(map(knots_of, edges)), coefficients, 3)


def assert_bounds(model, value, boxes: Boxes, rng: torch.Generator) -> None:
    """Values at random points of boxes are within the bounds of Taylor models, and near their polynomials."""
    low, high = model.bounds()
    # Rounding takes points at corners into the next cell, whose third derivatives are others.
    half = boxes.half_width * (1 - 1e-9)
    for k in range(12):
        e = 2 * torch.rand(half.shape, generator=rng, dtype=torch.float64) - 1
        e = e.sign() if k % 3 == 0 else e
        values = value(boxes.centre + half * e)
        assert (values >= low).all()
        assert (values <= high).all()
        polynomial = model.powers
        for j in reversed(range(e.shape[1])):
            powers = (e[:, j, None] * (1 - 1e-9)) ** torch.arange(polynomial.shape[-1])
            polynomial = (polynomial * powers.reshape(len(e), *[1] * (polynomial.ndim - 2), -1)).sum(-1)
        assert ((values - polynomial).abs() <= model.remainder + 1e-13 * model.size).all()


@pytest.mark.parametrize("orders", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 2, 0), (0, 1, 1), (0, 0, 2)])
def test_a_spline_and_its_derivatives_are_enclosed(orders):
    spline, oracle = random_spline(0)
    boxes = Boxes.cells(spline.edges)
    boxes = boxes.halves(torch.arange(len(boxes)) % 3)
    polynomials = spline.on(boxes)
    for axis, order in enumerate(orders):
        for _ in range(order):
            polynomials = polynomials.derivative(axis)

    def value(points):
        return torch.from_numpy(oracle(points.numpy(), nu=orders))

    assert_bounds(polynomials.model(), value, boxes, torch.Generator().manual_seed(3))


def test_bounds_of_polynomials_are_those_of_their_ends_where_they_rise():
    """e^3 + 2 e + y lies in [-4, 4]; of e^2 - e >= -1/4 the least Bernstein coefficient of degree 3 is -2/3."""
    powers = torch.zeros(2, 4, 2, dtype=torch.float64)
    powers[0, 3, 0], powers[0, 1, 0], powers[0, 0, 1] = 1.0, 2.0, 1.0
    powers[1, 2, 0], powers[1, 1, 0] = 1.0, -1.0
    low, high = TaylorModel(powers, torch.zeros(2, dtype=torch.float64)).bounds()
    assert low[0] == pytest.approx(-4, abs=1e-12)
    assert high[0] == pytest.approx(4, abs=1e-12)
    assert low[1] == pytest.approx(-2 / 3, abs=1e-12)
    assert high[1] == pytest.approx(2, abs=1e-12)


def test_products_of_splines_and_forms_are_enclosed():
    """W_x sin(3 y) - 2 W_yy + W exp(x): as a Taylor model it is enclosed, and much narrower than as an affine form."""
    spline, oracle = random_spline(1)
    boxes = Boxes.cells(spline.edges)
    z, w = boxes.coordinates(), spline.on(boxes)
    model = w.derivative(1).model() * (3 * z[:, 2]).sin() + w.model() * z[:, 1].exp()
    model = model + w.derivative(2).derivative(2).model() * Affine.of(-2.0, z[:, 0])

    def value(points):
        p = points.numpy()
        parts = (
            oracle(p, nu=(0, 1, 0)) * np.sin(3 * p[:, 2]) + oracle(p) * np.exp(p[:, 1]) - 2 * oracle(p, nu=(0, 0, 2))
        )
        return torch.from_numpy(parts)

    assert_bounds(model, value, boxes, torch.Generator().manual_seed(4))


def test_terms_of_taylor_models_cancel():
    """W e - e W is 0 up to rounding, while bounds of both terms are not."""
    spline, _ = random_spline(2)
    boxes = Boxes.cells(spline.edges)
    model, e = spline.on(boxes).model(), boxes.coordinates()[:, 1]
    low, high = (model * e + -(model * e)).bounds()
    assert ((high - low) / model.size).max() < 1e-9
    low, high = (model * e).bounds()
    assert (high - low).min() > 1e-3


def test_branch_and_bound_finds_the_boxes_that_resist():
    """x^2 > 0.01 fails in (-0.1, 0.1), and is proved up to the last halving elsewhere."""
    edges = [np.linspace(-1, 1, 5)]

    def positive(boxes):
        x = boxes.coordinates()[:, 0]
        return -(x * x - 0.01).low, torch.zeros(len(boxes), dtype=torch.long)

    outcome = prove(positive, Boxes.cells(edges), 0.0, 6, 1000)
    assert not outcome.proved
    assert outcome.margin == pytest.approx(0.01, rel=0.1)
    assert outcome.left.centre.abs().max() < 0.1 + 2 * outcome.left.half_width.max()
    assert outcome.left.half_width.max() == 0.25 / 2**6


def test_a_condition_that_fails_everywhere_is_left_before_its_boxes_are_millions():
    def fails(boxes):
        return torch.ones(len(boxes), dtype=torch.float64), torch.zeros(len(boxes), dtype=torch.long)

    outcome = prove(fails, Boxes.cells([np.linspace(-1, 1, 5)]), 0.0, 30, 100)
    assert len(outcome.left) == 128
    assert outcome.bounded == 4 + 8 + 16 + 32 + 64 + 128
    assert outcome.margin == 1.0


def test_what_cannot_be_computed_is_not_proved():
    """A bound that is not a number leaves its boxes, and no margin helps."""

    def undefined(boxes):
        return torch.full((len(boxes),), torch.nan), torch.zeros(len(boxes), dtype=torch.long)

    outcome = prove(undefined, Boxes.cells([np.linspace(0, 1, 3)]), 0.0, 1, 1000)
    assert len(outcome.left) == 4
    assert outcome.margin == math.inf


class Feedback(nn.Module):
    """A network that stands for an actor: tanh(gains . x + offset), reversed where both coordinates are large."""

    def __init__(self, *gains: float, offset: float = 0.0, reversed_corner: bool = False):
        super().__init__()
        self.weights = nn.Parameter(torch.tensor([[gain] for gain in gains]))
        self.offset, self.reversed_corner = offset, reversed_corner

    def forward(self, tau, state):
        u = torch.tanh(torch.matmul(state, self.weights) + self.offset)
        if not self.reversed_corner:
            return u
        corner = torch.sigmoid(20 * (state[..., :1] - 0.15)) * torch.sigmoid(20 * (state[..., 1:] - 0.2))
        return u * (1 - 2 * corner)


class Stand:
    """Stands for a `Solution`."""

    def __init__(self, problem, actor):
        self.problem, self.actor = problem, actor


def constant(sign: float) -> Feedback:
    """The control sign tanh(4), nearly that of the bound."""
    return Feedback(0.0, offset=4.0 * sign)


def assert_no_point_violates(proof: LowerBound, solution: Stand, count: int) -> None:
    """L^pi W >= 0 at sampled points where W - margin > 0, by another library's splines."""
    problem, rng = solution.problem, torch.Generator().manual_seed(5)
    x = problem.states.sample(count, rng, torch.float64)
    tau = problem.horizon * torch.rand(count, generator=rng, dtype=torch.float64)
    inside = problem.interior(x)
    x, tau = x[inside], tau[inside]
    points = torch.column_stack([tau, x]).numpy()
    w = NdBSpline(tuple(map(knots_of, proof.spline.edges)), proof.spline.coefficients.numpy(), 3)
    n = x.shape[1]

    def derivative(*axes: int):
        return torch.from_numpy(w(points, nu=tuple(axes.count(j) for j in range(n + 1))))

    with torch.no_grad():
        u = problem.controls.denormalize(copy.deepcopy(solution.actor).double()(tau.unsqueeze(-1), x))
    f, sigma = problem.drift(x, u), problem.diffusion(x, u)
    a = sigma @ sigma.mT
    residual = -derivative(0) + sum(f[:, i] * derivative(1 + i) for i in range(n))
    for i in range(n):
        for j in range(n):
            residual += 0.5 * a[:, i, j] * derivative(1 + i, 1 + j)
    asked = torch.from_numpy(w(points)) > proof.margin
    assert asked.double().mean() > 0.1
    assert residual[asked].min() >= -1e-9


@pytest.mark.parametrize("problem", [Reach1D(), Exit1D()])
def test_a_proved_bound_is_below_the_exact_probability_and_near(problem):
    """Under u = 1 the probability is known; the bound of tanh(4) = 0.9993 is below it at all of 20,000 points."""
    solution = Stand(problem, constant(1.0))
    proof = prove_success(solution, "none")
    assert proof.holds
    assert not proof.resisted
    x = problem.states.sample(20_000, torch.Generator().manual_seed(0), torch.float64)
    tau = problem.horizon * torch.rand(20_000, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    exact = problem.exact_value(tau, x).numpy()
    bound = proof.bound(tau.numpy(), x.numpy())
    assert (bound <= exact).all()
    start = proof.bound(np.array([problem.horizon]), np.zeros((1, 1)))[0]
    known = problem.exact_value(torch.tensor([problem.horizon]), torch.zeros(1, 1)).item()
    assert known - 0.06 < start < known
    assert_no_point_violates(proof, solution, 1_000_000)


class Switched(Reach1D):
    """Reach1D with a drift that is |u| below x = -1: under u > 0 it is the same."""

    def drift(self, x, u):
        return torch.where(x < -1, abs(u), u)


def test_a_drift_that_switches_is_proved():
    proof = prove_success(Stand(Switched(), constant(1.0)), "none", Settings(cells=32, steps=32))
    x = np.linspace(-1.9, 1.9, 50)[:, None]
    exact = Reach1D().exact_value(torch.full((50,), 2.0), torch.from_numpy(x)).numpy()
    bound = proof.bound(np.full(50, 2.0), x)
    assert (bound <= exact).all()
    assert (bound > exact - 0.15).all()


def test_a_smoothed_payoff_leaves_the_proof_as_it_is(tmp_path):
    """The hard sets count, and a file is read for either payoff."""
    smoothed, settings = Reach1D(payoff=LipschitzPayoff(0.3)), Settings(cells=16, steps=16)
    proof, hard = (prove_success(Stand(problem, constant(1.0)), "none", settings) for problem in (smoothed, Reach1D()))
    assert proof.holds
    points = np.full(4, 2.0), np.array([[-1.0], [0.0], [1.0], [1.9]])
    assert (proof.bound(*points) == hard.bound(*points)).all()
    assert proof.to_dict() | {"seconds": 0} == hard.to_dict() | {"seconds": 0}
    proof.save(tmp_path / "proof.npz")
    for problem in (smoothed, Reach1D()):
        assert LowerBound.load(tmp_path / "proof.npz", problem, "none").to_dict()["mean"] == hard.to_dict()["mean"]


def test_an_invariance_problem_is_proved():
    """A feedback towards the middle, of which 14,704 of 40,000 paths with a control step of 0.005 s stay inside."""
    proof = prove_success(Stand(Safety1D(), Feedback(-4.0)), "none")
    assert proof.holds
    assert 0.3 < proof.bound(np.array([2.0]), np.zeros((1, 1)))[0] < 0.37


class SlowSafety(Safety1D):
    """The same problem with 1,800 times longer seconds."""

    horizon = 1800 * Safety1D.horizon

    def drift(self, x, u):
        return super().drift(x, u) / 1800

    def diffusion(self, x, u):
        return super().diffusion(x, u) / 1800**0.5


def test_a_bound_does_not_depend_on_the_unit_of_time():
    x = np.array([[-0.5], [0.0], [0.5]])
    fast, slow = (prove_success(Stand(problem, Feedback(-4.0)), "none") for problem in (Safety1D(), SlowSafety()))
    assert slow.bound(np.full(3, 3600.0), x) == pytest.approx(fast.bound(np.full(3, 2.0), x), abs=1e-6)


def test_nothing_is_proved_for_a_policy_that_fails():
    """Under u = -1 the probability to reach 2 from 0 is exp(-4) = 0.018 times that under u = 1, by Girsanov."""
    proof = prove_success(Stand(Reach1D(), constant(-1.0)), "none")
    assert proof.bound(np.array([2.0]), np.zeros((1, 1)))[0] < 0.6277 * math.exp(-4)


@pytest.mark.slow
def test_two_states_are_proved_but_not_where_the_policy_is_reversed():
    """The pendulum under a linear feedback that saturates, and under one that is reversed where it falls to the right.

    Monte Carlo with a control step of 0.01 s gives the feedback a success of 1 at both starts, and the reversed one a
    success of 0 at the second.
    """
    problem, x = Pendulum(), np.array([[-0.2, 0.0], [0.25, 0.4]])
    tau = np.full(2, problem.horizon)
    solution = Stand(problem, Feedback(-6.0, -1.5))
    proof = prove_success(solution, "none")
    good, far = proof.bound(tau, x)
    assert good > 0.9
    assert far > 0.2
    assert_no_point_violates(proof, solution, 1_000_000)
    states = problem.states.sample(200, torch.Generator().manual_seed(1))

    def policy(t, y):
        return problem.controls.denormalize(solution.actor(t, y))

    estimate = monte_carlo(problem, policy, torch.full((200,), 2.0), states, 500, dt=0.01)
    # The interval of each state has a confidence of 95 %.
    assert (proof.bound(np.full(200, 2.0), states.numpy()) <= estimate.high.numpy()).mean() > 0.97
    worse = prove_success(Stand(problem, Feedback(-6.0, -1.5, reversed_corner=True)), "none")
    assert worse.bound(tau, x)[1] < 0.05


class Cube(ReachAvoidProblem):
    """dX = (0.3 (X_2, X_3, -X_1) + u) dt + 0.3 dW in R^3 with |u_i| <= 0.3: stay in |x_i| < 1 for T = 1 s."""

    objective = "invariance"
    horizon = 1.0
    states, controls = Box([-1.0] * 3, [1.0] * 3), Box([-0.3] * 3, [0.3] * 3)

    def drift(self, x, u):
        turned = torch.stack([x[..., 1], x[..., 2], -x[..., 0]], -1)
        return 0.3 * turned + u

    def diffusion(self, x, u):
        return 0.3 * torch.eye(3, dtype=x.dtype).expand(len(x), 3, 3)

    def avoid_constraints(self, x):
        return 1 - x.abs()


class Towards(nn.Module):
    """A network that stands for an actor: tanh(-2 x) in each coordinate."""

    def forward(self, tau, state):
        return torch.tanh(-2.0 * state)


def test_three_states_are_proved_on_a_coarse_mesh():
    problem = Cube()
    solution = Stand(problem, Towards())
    proof = prove_success(solution, "none", Settings(cells=8, steps=8))
    assert "interior" not in proof.resisted
    assert proof.bound(np.array([1.0]), np.zeros((1, 3)))[0] > 0.5
    assert_no_point_violates(proof, solution, 100_000)


@pytest.mark.slow
def test_three_states_are_proved_on_the_default_mesh():
    """Nowhere above the intervals of Monte Carlo with a control step of 0.01 s, except by their confidence of 95 %."""
    problem, actor = Cube(), Towards()
    solution = Stand(problem, actor)
    proof = prove_success(solution, "none")
    found = proof.to_dict()
    assert found["share_at_least_0.5"] > 0.4
    assert found["share_at_least_0.8"] > 0.1
    assert_no_point_violates(proof, solution, 1_000_000)
    states = problem.states.sample(200, torch.Generator().manual_seed(1))

    def policy(t, y):
        return problem.controls.denormalize(actor(t, y))

    estimate = monte_carlo(problem, policy, torch.ones(200), states, 500, dt=0.01)
    assert (proof.bound(np.ones(200), states.numpy()) <= estimate.high.numpy()).mean() > 0.97


def test_least_squares_and_states_on_a_lattice_agree_with_full_matrices():
    """The band's factors against scipy's general least squares, and products of small matrices against a large one."""
    problem, rng = Cube(), np.random.default_rng(0)
    mesh = mesh_of(Ends(problem, success=True), 8, 8)
    axes = mesh.points([0.0, 0.3, 0.7])
    chosen = rng.random(len(product(axes))) < 0.3
    lattice, points = Lattice(problem, mesh, axes, chosen), Points(problem, mesh, product(axes)[chosen])
    coefficients = rng.normal(size=points.values.shape[1])
    assert (lattice.x == points.x).all()
    assert lattice.value(coefficients) == pytest.approx(points.values @ coefficients, abs=1e-12)
    factors = rng.normal(size=(9, len(points.x)))
    expected = points.operator(factors) @ coefficients
    assert (factors * lattice.derive(coefficients)).sum(0) == pytest.approx(expected, abs=1e-9)
    small = mesh_of(Ends(DoubleIntegrator(), success=True), 8, 8)
    rows = design(
        small.space, DoubleIntegrator().states.sample(2_000, torch.Generator().manual_seed(1)).double().numpy()
    )
    right = rng.normal(size=2_000)
    known = np.linalg.lstsq(rows.toarray(), right, rcond=None)[0]
    assert NormalEquations(rows).solve(right) == pytest.approx(known, abs=1e-8)


def test_a_bound_takes_what_its_conditions_lack():
    """On a mesh that is too coarse conditions fail, and the margin grows until they hold, here to all of W."""
    proof = prove_success(Stand(Reach1D(), constant(1.0)), "none", Settings(cells=8, steps=8, rounds=1, halvings=0))
    assert "interior" in proof.resisted
    assert proof.margin > 0.5
    x = np.linspace(-1.9, 1.9, 50)[:, None]
    exact = Reach1D().exact_value(torch.full((50,), 2.0), torch.from_numpy(x)).numpy()
    assert (proof.bound(np.full(50, 2.0), x) <= exact).all()


def test_a_proof_is_read_for_its_networks_alone(tmp_path):
    proof = prove_success(Stand(Reach1D(), constant(1.0)), "a" * 64)
    proof.save(tmp_path / "proof.npz")
    points = np.full(3, 1.5), np.array([[-1.0], [0.0], [1.0]])
    assert (LowerBound.load(tmp_path / "proof.npz", Reach1D(), "a" * 64).bound(*points) == proof.bound(*points)).all()
    with pytest.raises(ProofError, match="networks with SHA-256 aaaaaaaaaaaa, and those of this run have bbbbbbbbbbbb"):
        LowerBound.load(tmp_path / "proof.npz", Reach1D(), "b" * 64)
    with pytest.raises(ProofError, match="about a problem with other drift, noise, sets, controls or horizon"):
        LowerBound.load(tmp_path / "proof.npz", Reach1D(horizon=1.0), "a" * 64)
    (tmp_path / "proof.npz").write_bytes(b"no proof")
    with pytest.raises(ProofError, match="expected a file of `certify method=interval`"):
        LowerBound.load(tmp_path / "proof.npz", Reach1D(), "a" * 64)
    with pytest.raises(ProofError, match="expected a file of `certify method=interval`"):
        LowerBound.load(tmp_path / "missing.npz", Reach1D(), "a" * 64)


def flat(edges: list[np.ndarray], level: float) -> LowerBound:
    """W = level for Reach1D, with a margin of 0.1."""
    spline = Spline(edges, np.full([len(axis) + 2 for axis in edges], level))
    return LowerBound(problem=Reach1D(), spline=spline, margin=0.1, resisted={}, boxes=0, seconds=0.0, networks="none")


def test_a_proof_holds_where_it_says_something_of_states_outside_the_sets():
    """W is above its margin in A alone, where it has no meaning."""
    edges = [np.linspace(0, 2, 3), np.linspace(-2, 2.4, 45)]
    assert flat(edges, 1.0).holds
    assert not flat(edges, 0.0).holds
    proof = flat(edges, 0.0)
    proof.spline.coefficients[:, -2:] = 1.0
    assert not proof.holds


@pytest.mark.parametrize(("tau", "x"), [(2.5, 0.0), (-0.1, 0.0), (1.0, -3.0), (1.0, math.nan)])
def test_a_bound_is_given_within_its_box_alone(tau, x):
    edges = [np.linspace(0, 2, 3), np.linspace(-2, 2, 5)]
    proof = flat(edges, 1.0)
    assert proof.bound(np.array([1.0]), np.array([[0.0]]))[0] == pytest.approx(0.9)
    with pytest.raises(ProofError, match=r"bound: expected \(tau, x\) between \[0.0, -2.0\] and \[2.0, 2.0\]"):
        proof.bound(np.array([tau]), np.array([[x]]))


def test_the_target_without_corners_lies_in_the_target():
    """Points of its face are on its level, in A, and close to A's face where that has no corner."""
    problem = DoubleIntegrator()
    ends = Ends(problem, success=True)
    mesh = mesh_of(ends, 40, 10)
    x = product(mesh.points([0.5]))
    level = smooth_target(ends, torch.from_numpy(x))
    points = face_points(level, mesh, x)
    assert len(points) > 20
    assert level(torch.from_numpy(points)).abs().max() < 1e-9
    constraints = problem.reached_constraints(torch.from_numpy(points)).amax(-1)
    assert constraints.max() <= 1e-9
    assert constraints.max() > -0.05
    circle = face_points(lambda y: y.norm(dim=-1) - 0.5, mesh, x)
    assert np.linalg.norm(circle, axis=1) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("problem", "message"), [(HalfSpace(dim=4), "at most 3 states, got 4"), (DubinsCar(), "no periodic coordinates")]
)
def test_problems_beyond_the_method_are_refused(problem, message):
    with pytest.raises(ProofError, match=message):
        prove_success(Stand(problem, constant(1.0)), "none")


def test_a_grid_has_no_network_to_prove():
    with pytest.raises(ProofError, match="expected a policy that is a network, got that of a grid"):
        prove_success(GridSolver(Reach1D(), 11, estimate=False).solve(), "none")


def test_a_policy_that_jumps_is_refused():
    problem = Reach1D()
    with pytest.raises(ProofError, match=r"expected a continuous policy, .* chooses among 3 numbers"):
        prove_success(Stand(problem, Actor(problem, choices=3)), "none")


def test_a_side_in_the_target_is_moved_outward():
    mesh = mesh_of(Ends(Exit1D(), success=True), 10, 10)
    assert mesh.edges[1][0] == -1
    assert mesh.edges[1][-1] == pytest.approx(1.1)


def test_the_command_writes_a_proof(trained, in_process):
    """The bound of the file is that of the printed lines, and belongs to the networks of the run."""
    code, text = in_process(certify)(f"run={trained}", "method=interval", "cells=40", "steps=40")
    assert code == 0, text
    found = json.loads((trained / "proof.json").read_text())
    assert found["holds"], found
    assert f"at least {found['best']:.4f}" in text
    run = load_run(trained)
    assert found["networks"] == Deployed(run.solution, run.simulator).digest()
    assert (trained / "figures" / "proof.png").stat().st_size > 10_000
    proof = run.load_proof(trained / "proof.npz")
    assert proof.bound(np.array([run.problem.horizon]), np.array([found["best_state"]]))[0] == found["best"]
    with torch.no_grad():
        next(run.solution.actor.parameters()).add_(1e-6)
    with pytest.raises(ProofError, match="it proves something about networks with SHA-256"):
        run.load_proof(trained / "proof.npz")
    code, text = in_process(certify)(
        f"run={trained}", "method=interval", "cells=8", "steps=8", "rounds=1", "halvings=0"
    )
    assert code == 0
    assert "W is lowered by" in text
    assert "resists   interior" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["method=intervall"], "method: expected statistical or interval, got 'intervall'"),
        (["method=interval", "episodes=5"], "episodes=5: expected key=value with a key out of bounds, cells, halvings"),
        (["method=interval", "cells=0"], "cells: expected an integer >= 8, got 0"),
    ],
)
def test_a_wrong_command_is_one_sentence(arguments, message, trained, in_process):
    code, text = in_process(certify)(f"run={trained}", *arguments)
    assert code == 1
    assert "Traceback" not in text
    assert message in text


def test_products_without_an_enclosure_are_refused():
    form = Affine.of_box(torch.zeros(3, 2, dtype=torch.float64), torch.ones(3, 2, dtype=torch.float64))
    with pytest.raises(ProofError, match="both depend on the state"):
        form.unsqueeze(-2) @ form.unsqueeze(-1)
    with pytest.raises(ProofError, match=r"expected a matrix \(k, l\) and columns"):
        MATRIX @ form
    with pytest.raises(ProofError, match="expected the Euclidean norm of order 2, got order 1"):
        torch.linalg.vector_norm(form, ord=1, dim=-1)


def test_the_size_of_the_units_does_not_hide_another_problem(tmp_path):
    """In nanometres, written in m, everything is smaller than any absolute tolerance."""

    class Small(Reach1D):
        scale, noise = 1e-9, 1.0
        states = Box([-2e-9], [2e-9])

        def drift(self, x, u):
            return self.scale * u

        def diffusion(self, x, u):
            return torch.full((*x.shape, 1), self.noise * self.scale, dtype=x.dtype)

        def target_level(self, x):
            return 2e-9 - x[..., 0]

    edges = [np.linspace(0, 2, 3), np.linspace(-2e-9, 2.4e-9, 45)]
    spline = Spline(edges, np.ones([len(axis) + 2 for axis in edges]))
    proof = LowerBound(problem=Small(), spline=spline, margin=0.1, resisted={}, boxes=0, seconds=0.0, networks="none")
    proof.save(tmp_path / "proof.npz")
    other = Small()
    other.noise = 1.2
    assert LowerBound.load(tmp_path / "proof.npz", Small(), "none").margin == 0.1
    with pytest.raises(ProofError, match="about a problem with other drift"):
        LowerBound.load(tmp_path / "proof.npz", other, "none")
