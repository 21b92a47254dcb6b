"""Proofs: enclosures contain what they enclose, and proved bounds are below exact probabilities."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from scipy.interpolate import NdBSpline
from torch import nn

from pirl_rl import certify, load_run
from pirl_rl.certificates import Deployed
from pirl_rl.errors import ProofError
from pirl_rl.grid import GridSolver
from pirl_rl.networks import Actor
from pirl_rl.problems import DoubleIntegrator, DubinsCar, Exit1D, HalfSpace, Pendulum, Reach1D, Safety1D, ZermeloBoat
from pirl_rl.proofs import Settings, load_bound, prove_success
from pirl_rl.proofs.affine import Affine
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.mesh import mesh_of
from pirl_rl.proofs.search import prove
from pirl_rl.proofs.spline import Spline, knots_of

FUNCTIONS = {
    "abs": lambda z: z.abs(),
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


def test_an_unknown_function_is_refused():
    form = Affine.of_box(torch.zeros(1, 1, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64))
    with pytest.raises(ProofError, match=r"torch\.erf: no enclosure"):
        torch.erf(form)
    with pytest.raises(ProofError, match="sqrt: its argument is not positive"):
        form.sqrt()


@pytest.mark.parametrize("orders", [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 2, 0), (0, 1, 1), (0, 0, 2)])
def test_a_spline_and_its_derivatives_are_enclosed(orders):
    rng = np.random.default_rng(0)
    edges = [np.linspace(0, 2, 7) ** 1.5, np.linspace(-2, 2, 9), np.linspace(-1, 1, 5)]
    coefficients = rng.normal(size=[len(axis) + 2 for axis in edges])
    oracle = NdBSpline(tuple(map(knots_of, edges)), coefficients, 3)
    boxes = Boxes.cells(edges)
    boxes = boxes.halves(torch.arange(len(boxes)) % 3)
    polynomials = Spline(edges, coefficients).on(boxes)
    for axis, order in enumerate(orders):
        for _ in range(order):
            polynomials = polynomials.derivative(axis)

    def value(points):
        return torch.from_numpy(oracle(points.numpy(), nu=orders))

    # Rounding takes points at corners into the next cell, whose third derivatives are others.
    inner = boxes.half_width * (1 - 1e-9)
    assert_encloses(polynomials.enclosure(), value, boxes.centre, inner, torch.Generator().manual_seed(3))


def test_branch_and_bound_finds_the_boxes_that_resist():
    """x^2 > 0.01 fails in (-0.1, 0.1), and is proved up to the last halving elsewhere."""
    edges = [np.linspace(-1, 1, 5)]

    def positive(boxes):
        x = boxes.coordinates()[:, 0]
        return (x * x - 0.01).low > 0, torch.zeros(len(boxes), dtype=torch.long)

    outcome = prove(positive, Boxes.cells(edges), 6)
    assert not outcome.proved
    assert outcome.left.centre.abs().max() < 0.1 + 2 * outcome.left.half_width.max()
    assert outcome.left.half_width.max() == 0.25 / 2**6


class Feedback(nn.Module):
    """A network that stands for an actor: tanh(gain x), so that its sign is that of the gain."""

    def __init__(self, gain: float, offset: float = 0.0):
        super().__init__()
        self.weights = nn.Parameter(torch.tensor([[gain]]))
        self.offset = offset

    def forward(self, tau, state):
        return torch.tanh(torch.matmul(state, self.weights) + self.offset)


class Stand:
    """Stands for a `Solution`."""

    def __init__(self, problem, actor):
        self.problem, self.actor = problem, actor


QUICK = Settings(cells=48, steps=48, halvings=8)


def constant(sign: float) -> Feedback:
    """The control sign tanh(4), nearly that of the bound."""
    return Feedback(0.0, 4.0 * sign)


@pytest.mark.parametrize("problem", [Reach1D(), Exit1D()])
def test_a_proved_bound_is_below_the_exact_probability_and_near(problem):
    """Under u = 1 the probability is known; the bound of tanh(4) = 0.9993 is below it at all of 20,000 points."""
    proof = prove_success(Stand(problem, constant(1.0)), "none", QUICK)
    assert proof.holds
    x = problem.states.sample(20_000, torch.Generator().manual_seed(0), torch.float64)
    tau = problem.horizon * torch.rand(20_000, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    exact = problem.exact_value(tau, x).numpy()
    bound = proof.bound(tau.numpy(), x.numpy())
    assert (bound <= exact).all()
    start = proof.bound(np.array([problem.horizon]), np.zeros((1, 1)))[0]
    known = problem.exact_value(torch.tensor([problem.horizon]), torch.zeros(1, 1)).item()
    assert known - 0.06 < start < known


def test_an_invariance_problem_is_proved():
    """A feedback towards the middle, of which 14,704 of 40,000 paths with a control step of 0.005 s stay inside."""
    proof = prove_success(Stand(Safety1D(), Feedback(-4.0)), "none", QUICK)
    assert proof.holds
    assert 0.3 < proof.bound(np.array([2.0]), np.zeros((1, 1)))[0] < 0.37


def test_nothing_is_proved_for_a_policy_that_fails():
    """Under u = -1 the probability to reach 2 from 0 is exp(-4) = 0.018 times that under u = 1, by Girsanov."""
    proof = prove_success(Stand(Reach1D(), constant(-1.0)), "none", QUICK)
    assert proof.holds
    assert proof.bound(np.array([2.0]), np.zeros((1, 1)))[0] < 0.6277 * math.exp(-4)


def test_a_bound_that_is_not_proved_is_never_given():
    proof = prove_success(Stand(Reach1D(), constant(1.0)), "none", Settings(cells=12, steps=12, rounds=1, halvings=1))
    assert not proof.holds
    with pytest.raises(ProofError, match="no bound: conditions are not proved, interior on"):
        proof.bound(np.array([2.0]), np.zeros((1, 1)))


@pytest.mark.parametrize(
    ("problem", "message"), [(HalfSpace(dim=4), "at most 3 states, got 4"), (DubinsCar(), "no periodic coordinates")]
)
def test_problems_beyond_the_method_are_refused(problem, message):
    with pytest.raises(ProofError, match=message):
        prove_success(Stand(problem, constant(1.0)), "none")


def test_a_grid_has_no_network_to_prove():
    with pytest.raises(ProofError, match="expected a policy that is a network, got that of a grid"):
        prove_success(GridSolver(Reach1D(), 11, estimate=False).solve(), "none")


def test_a_side_in_the_target_is_moved_outward():
    mesh = mesh_of(Exit1D(), 10, 10)
    assert mesh.beyond == [(False, True)]
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
    bound = load_bound(trained / "proof.npz", found["networks"])
    best = bound(np.array([run.problem.horizon]), np.array([found["best_state"]]))
    assert best[0] == pytest.approx(found["best"])
    assert load_bound(trained / "proof.npz", "other networks") is None
    with pytest.raises(ProofError, match="expected a proved bound"):
        load_bound(trained / "proof.json", found["networks"])
    code, text = in_process(certify)(f"run={trained}", "method=interval", "cells=10", "rounds=1", "halvings=0")
    assert code == 0
    assert "Nothing is proved: some conditions resist." in text
    assert not json.loads((trained / "proof.json").read_text())["holds"]
    assert not (trained / "proof.npz").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["method=intervall"], "method: expected statistical or interval, got 'intervall'"),
        (["method=interval", "episodes=5"], "episodes=5: expected key=value with a key out of cells, halvings"),
        (["method=interval", "cells=0"], "cells: expected an integer >= 8, got 0"),
    ],
)
def test_a_wrong_command_is_one_sentence(arguments, message, trained, in_process):
    code, text = in_process(certify)(f"run={trained}", *arguments)
    assert code == 1
    assert "Traceback" not in text
    assert message in text
