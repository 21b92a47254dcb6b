"""The largest L^u V over the controls, against every control of a grid and against closed forms."""

from __future__ import annotations

import itertools

import pytest
import torch
from oracles import Circle, FullNoise, name, random_solution
from torch import Tensor

from pirl_rl.evaluation import Residuals
from pirl_rl.evaluation.largest_residual import largest_residual
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import Reach1D, VehicleDrift
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator


class Controlled(ReachAvoidProblem):
    """n states and m controls, whose columns of the drift are those of a fixed random matrix; no avoid set."""

    horizon = 1.0

    def __init__(self, n: int, m: int):
        super().__init__()
        self.states, self.controls = Box([-1.0] * n, [1.0] * n), Box([-0.5] * m, [1.5] * m)
        self.matrix = torch.randn(n, m, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        self.calls = 0

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        self.calls += 1
        return u @ self.matrix.to(u).mT - x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.5 * torch.eye(x.shape[-1]).to(x)).expand(*x.shape, x.shape[-1])

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]


class Curved(Controlled):
    """The drift is a sum of waves of single controls."""

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return super().drift(x, torch.sin(3 * u) - 0.5 * u**2)


class Noisy(Curved):
    """Each control adds a channel of noise, of a size that depends on it."""

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return self.matrix.to(u) * (0.2 + 0.3 * torch.cos(2 * u)).unsqueeze(-2)


class Coupled(Controlled):
    """Neighbouring controls multiply, so that a single change may not help where two would."""

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return super().drift(x, u * u.roll(1, -1))


def sample(problem, count: int = 200):
    x = problem.states.sample(count, torch.Generator().manual_seed(0), torch.float64)
    return torch.linspace(0.1, 1, count, dtype=torch.float64), x


def every_control(solution, tau: Tensor, x: Tensor, levels: int) -> Tensor:
    """The maximum over all controls whose coordinates are a level or the policy's, by Ito propagation for each."""
    box, best = solution.problem.controls, solution.residual(tau, x)
    own = box.normalize(solution.policy(tau, x))
    axis = torch.linspace(-1, 1, levels, dtype=x.dtype)
    for choice in itertools.product([None, *axis], repeat=box.dim):
        columns = [own[:, i] if level is None else level.expand(len(x)) for i, level in enumerate(choice)]
        best = torch.maximum(best, solution.residual(tau, x, box.denormalize(torch.stack(columns, -1))))
    return best


@pytest.fixture
def _ascent_alone(monkeypatch):
    monkeypatch.setattr("pirl_rl.evaluation.largest_residual.EXHAUSTIVE", 1)


@pytest.mark.usefixtures("_ascent_alone")
@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("kind", [Controlled, Curved, Noisy])
def test_ascent_is_exact_where_the_effects_of_controls_add_up(kind, m):
    problem = kind(3, m)
    solution, (tau, x) = random_solution(problem), sample(problem)
    along, oracle = solution.residual(tau, x), every_control(solution, tau, x, 5)
    assert (oracle - along).mean() > 0.01
    torch.testing.assert_close(largest_residual(solution, tau, x, along, 5), oracle, rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("_ascent_alone")
@pytest.mark.parametrize("problem", [kind for m in (2, 3) for kind in (Coupled(3, m), FullNoise(3, m, 2))], ids=name)
def test_ascent_of_coupled_controls_is_nearly_exact(problem):
    """Measured: at least 99 % of the points have the maximum, and the mean square is 0.9998 of the maximum's."""
    solution, (tau, x) = random_solution(problem), sample(problem)
    along, oracle = solution.residual(tau, x), every_control(solution, tau, x, 5)
    found = largest_residual(solution, tau, x, along, 5)
    assert (found >= along).all()
    assert (found < oracle - 1e-9).double().mean() <= 0.02
    assert found.square().mean() > 0.99 * oracle.square().mean()


def test_a_few_controls_are_all_tried_and_keep_their_digits():
    """One control has its levels in ascending order, and two have all pairs: equal bit for bit."""
    for problem in (Reach1D(), VehicleDrift()):
        solution, (tau, x) = random_solution(problem, torch.float32), sample(problem)
        tau, x = tau.float(), x.float()
        along = expected = solution.residual(tau, x)
        for action in itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=problem.controls.dim):
            u = problem.controls.denormalize(torch.tensor(action)).expand(len(x), -1)
            expected = torch.maximum(expected, solution.residual(tau, x, u))
        assert torch.equal(largest_residual(solution, tau, x, along, 5), expected)


def test_cost_is_linear_in_the_number_of_controls():
    calls = []
    for m in (4, 8, 12, 16):
        problem = Curved(3, m)
        solution, (tau, x) = random_solution(problem), sample(problem)
        along, before = solution.residual(tau, x), problem.calls
        largest_residual(solution, tau, x, along, 5)
        calls.append(problem.calls - before)
    assert calls[0] > 0
    assert len({b - a for a, b in itertools.pairwise(calls)}) == 1


def test_thirty_controls_and_a_hundred_states():
    """The maximum over the box is known: the sign of a control's column along grad V says which bound is better."""
    problem = Controlled(100, 30)
    solution, (tau, x) = random_solution(problem, torch.float32), sample(problem)
    tau, x = tau.float(), x.float()
    along = solution.residual(tau, x)
    effect = solution.gradient(tau, x) @ problem.matrix.float()
    expected = along - (effect * (solution.policy(tau, x) - 0.5)).sum(-1) + effect.abs().sum(-1)
    torch.testing.assert_close(largest_residual(solution, tau, x, along, 5), expected, rtol=1e-4, atol=1e-4)
    metrics = Residuals(256)(solution, Simulator(problem, 0.1)).metrics()
    assert metrics["hjb_sup_loss"] > metrics["hjb_loss"]


@pytest.mark.parametrize("problem", [Circle(), FullNoise(3, 2, 2)], ids=name)
def test_hessian_is_that_of_the_raw_value(problem):
    solution, (tau, x) = random_solution(problem), sample(problem, 20)
    action, n = solution._action(tau, x).detach(), problem.states.dim
    inputs = x.clone().requires_grad_()
    value = solution.critic.at(action)(tau, inputs).mean(0).sum()
    (slope,) = torch.autograd.grad(value, inputs, create_graph=True)
    rows = [torch.autograd.grad(slope[:, i].sum(), inputs, retain_graph=True)[0] for i in range(n)]
    hessian = solution.hessian(tau, x)
    assert not hessian.requires_grad
    torch.testing.assert_close(hessian, torch.stack(rows, -2), rtol=1e-9, atol=1e-10)
