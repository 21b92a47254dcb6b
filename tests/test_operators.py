"""The generator: fast path and torch.func against nested autograd, and against what a generator is."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from oracles import PROBLEMS, FullNoise, name, nested_generator, points
from torch import nn

from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Critic, stack
from pirl_rl.operators import ACTIVATIONS, advection, generator, require_twice_differentiable
from pirl_rl.problems import Reach1D

RELATIVE = 1e-10


@pytest.fixture(autouse=True)
def _float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def random_critic(problem, activation: str = "Tanh", seed: int = 0, **kwargs) -> Critic:
    """Weights and biases far from zero, so that every derivative of every activation counts."""
    torch.manual_seed(seed)
    critic = Critic(problem, (9, 7), activation, **{"output": "Sigmoid", "action_input": True, **kwargs})
    for parameter in critic.parameters():
        nn.init.normal_(parameter, std=0.7)
    return critic


def plain(critic, action):
    """The same function as `critic.at(action)`, in a form the fast path does not know."""
    return lambda tau, x: critic(tau.unsqueeze(-1), x, action).squeeze(-1)


def distance(a, b) -> float:
    return ((a - b).norm() / b.norm()).item()


def assert_same(critic, ours, oracle):
    """Values, and the gradient of every parameter through a nonlinear function of them, relative."""
    assert distance(ours, oracle) < RELATIVE
    parameters = list(critic.parameters())
    gradients = [
        torch.autograd.grad(result.square().sum(), parameters, allow_unused=True, materialize_grads=True)
        for result in (ours, oracle)
    ]
    for mine, theirs in zip(*gradients, strict=True):
        assert (mine - theirs).norm() <= RELATIVE * theirs.norm()
    # A linear output's bias enters the value alone: no derivative depends on it.
    linear = isinstance(critic.layers[-1], nn.Linear)
    assert all(gradient.norm() > 0 for gradient in gradients[1][: -1 if linear else None])


@pytest.mark.parametrize("activation", [kind.__name__ for kind in ACTIVATIONS])
@pytest.mark.parametrize("problem", [FullNoise(1, 1, 2), FullNoise(8, 2, 3)], ids=name)
@pytest.mark.parametrize("path", ["fast", "torch.func"])
def test_equals_nested_autograd(problem, activation, path):
    critic = random_critic(problem, activation)
    tau, x, action, u = points(problem, 20)
    value = critic.at(action) if path == "fast" else plain(critic, action)
    ours = generator(value, problem, tau, x, u)
    assert_same(critic, ours, nested_generator(plain(critic, action), problem, tau, x, u))


@pytest.mark.parametrize("action_input", [False, True])
@pytest.mark.parametrize(
    ("root_time", "output", "levels"),
    [(False, "Sigmoid", False), (True, None, False), (True, "Sigmoid", True), (True, "Sigmoid", "logarithms")],
)
@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_every_problem_equals_nested_autograd(problem, root_time, output, levels, action_input):
    critic = random_critic(
        problem,
        root_time=root_time,
        output=output,
        levels=bool(levels),
        log_levels=levels == "logarithms",
        action_input=action_input,
    )
    tau, x, action, u = points(problem, 20)
    ours = generator(critic.at(action), problem, tau, x, u)
    assert_same(critic, ours, nested_generator(plain(critic, action), problem, tau, x, u))


@pytest.mark.parametrize("problem", [FullNoise(1, 1, 2), FullNoise(8, 2, 3)], ids=name)
def test_stacked_critics_equal_each_alone(problem):
    critics = [random_critic(problem, seed=seed, levels=True, log_levels=True) for seed in range(2)]
    twin = stack(critics)
    tau, x, action, u = points(problem, 20)
    both = generator(twin.at(action), problem, tau, x, u)
    assert both.shape == (2, 20)
    stacked = torch.autograd.grad(both.square().sum(), list(twin.parameters()))
    for index, critic in enumerate(critics):
        alone = nested_generator(plain(critic, action), problem, tau, x, u)
        assert distance(both[index], alone) < RELATIVE
        for mine, theirs in zip(
            stacked, torch.autograd.grad(alone.square().sum(), list(critic.parameters())), strict=True
        ):
            assert distance(mine[index], theirs) < RELATIVE


@pytest.mark.parametrize("path", ["fast", "torch.func"])
def test_gradient_reaches_parameters_through_the_hessian(path):
    problem = FullNoise(3, 1, 2)
    critic = random_critic(problem)
    tau, x, action, u = points(problem, 20)
    value = critic.at(action) if path == "fast" else plain(critic, action)

    class Silent(FullNoise):
        def diffusion(self, x, u):
            return 0 * super().diffusion(x, u)

    # First-order terms cancel: what is left is 1/2 Tr(sigma sigma^T hess V) alone.
    second = generator(value, problem, tau, x, u) - generator(value, Silent(3, 1, 2), tau, x, u)
    inputs, sigma = x.clone().requires_grad_(), problem.diffusion(x, u)
    (gradient,) = torch.autograd.grad(plain(critic, action)(tau, inputs).sum(), inputs, create_graph=True)
    rows = [torch.autograd.grad(column.sum(), inputs, create_graph=True)[0] for column in gradient.unbind(-1)]
    oracle = (sigma @ sigma.mT * torch.stack(rows, -1)).sum((-2, -1)) / 2
    assert_same(critic, second, oracle)


def test_gradient_reaches_the_control():
    problem = FullNoise(3, 2, 2)
    critic = random_critic(problem)
    tau, x, action, u = points(problem, 20)
    u.requires_grad_()
    fast, forward = (
        torch.autograd.grad(generator(value, problem, tau, x, u).square().sum(), u)[0]
        for value in (critic.at(action), plain(critic, action))
    )
    assert distance(fast, forward) < RELATIVE
    step = 1e-5 * torch.randn(u.shape, generator=torch.Generator().manual_seed(0))
    ahead, behind = (
        generator(critic.at(action), problem, tau, x, u + sign * step).square().sum().item() for sign in (1, -1)
    )
    assert (ahead - behind) / 2 == pytest.approx((fast * step).sum().item(), rel=1e-6)


class FreeNoise(FullNoise):
    """A full sigma that depends on the state alone."""

    def diffusion(self, x, u):
        return super().diffusion(x, 0 * u)


@pytest.mark.parametrize("path", ["fast", "torch.func"])
@pytest.mark.parametrize("problem", [Reach1D(), FreeNoise(3, 2, 2)], ids=name)
def test_advection_is_the_generator_but_for_a_term_without_the_control(problem, path):
    critic = random_critic(problem)
    tau, x, action, u = points(problem, 20)
    value = critic.at(action) if path == "fast" else plain(critic, action)
    u.requires_grad_()
    ours, whole = (operator(value, problem, tau, x, u) for operator in (advection, generator))
    assert distance(*(torch.autograd.grad(result.sum(), u)[0] for result in (ours, whole))) < RELATIVE
    rest = whole - ours
    assert rest.norm() > 0.01 * whole.norm()
    assert distance(generator(value, problem, tau, x, -u) - advection(value, problem, tau, x, -u), rest) < RELATIVE


@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_is_the_derivative_of_the_expectation(problem):
    """(E[phi(tau - h, x + f h + sigma sqrt(h) z)] - phi(tau, x))/h -> L^u phi, first order in h."""
    critic = random_critic(problem)
    tau, x, action, u = points(problem, 16)
    phi = plain(critic, action)
    f, sigma = problem.drift(x, u), problem.diffusion(x, u)
    nodes, weights = np.polynomial.hermite_e.hermegauss(3)
    errors = []
    for h in (1e-3, 5e-4, 2.5e-4):
        expectation = torch.zeros_like(tau)
        for index in itertools.product(range(3), repeat=sigma.shape[-1]):
            z, weight = (
                torch.tensor(nodes[list(index)]),
                np.prod(weights[list(index)]) / (2 * math.pi) ** (len(index) / 2),
            )
            expectation = expectation + weight * phi(tau - h, x + f * h + math.sqrt(h) * (sigma @ z))
        quotient = (expectation - phi(tau, x)) / h
        errors.append((quotient - generator(critic.at(action), problem, tau, x, u)).norm().item())
    for coarse, fine in itertools.pairwise(errors):
        assert coarse / fine == pytest.approx(2, rel=0.1)


def test_exact_solution_has_no_residual():
    problem = Reach1D()
    tau, x = torch.meshgrid(torch.linspace(0.05, 2, 40), torch.linspace(-2, 1.95, 40), indexing="ij")
    tau, x = tau.flatten(), x.reshape(-1, 1)
    residual = generator(problem.exact_value, problem, tau, x, problem.optimal_control(tau, x))
    assert residual.abs().max() <= 1e-10


def test_a_control_that_is_not_optimal_has_a_negative_residual():
    problem = Reach1D()
    tau, x, _, _ = points(problem, 100)
    residual = generator(problem.exact_value, problem, 0.1 + tau, x.clamp(max=1.9), -torch.ones_like(x))
    assert (residual < 0).all()


def test_a_network_without_second_derivatives_is_refused_by_name():
    with pytest.raises(ArgumentError, match=r"expected one of .*Tanh.*, got ReLU"):
        require_twice_differentiable(Critic(Reach1D(), (4,), "ReLU").layers)
    for kind in ACTIVATIONS:
        require_twice_differentiable(Critic(Reach1D(), (4,), kind.__name__).layers)


@pytest.mark.parametrize("kind", ACTIVATIONS, ids=lambda kind: kind.__name__)
def test_derivatives_of_activations(kind):
    z = torch.linspace(-15, 15, 201, requires_grad=True)
    y, slope, curvature = ACTIVATIONS[kind](z)
    oracle = kind()(z)
    (first,) = torch.autograd.grad(oracle.sum(), z, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), z)
    for ours, theirs in ((y, oracle), (slope, first), (curvature, second)):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-14)
