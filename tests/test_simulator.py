"""Simulated exit rates against exact ones, and the step against the generator.

Statistical tests have fixed seeds and ask for agreement within three standard errors.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import PROBLEMS, Corner, FullNoise, name, points
from torch import Tensor

from pirl_rl.networks import Critic
from pirl_rl.operators import generator
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import Reach1D, Safety1D, ZermeloBoat
from pirl_rl.sampling.initial_states import sample_interior
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator

GOLDEN = np.load(Path(__file__).parent / "data" / "reach1d_value.npz")


def rates(simulator: Simulator, start: list[float], u: list[float], steps: int, paths: int, seed: int = 0):
    """Fractions of paths that reached and failed within `steps` control steps."""
    rng = torch.Generator().manual_seed(seed)
    x = torch.tensor(start, dtype=torch.float64).repeat(paths, 1)
    reached, failed = 0, 0
    for _ in range(steps):
        control = torch.tensor(u, dtype=x.dtype).expand(len(x), -1)
        step = simulator.step(x, control, rng)
        reached, failed = reached + int(step.reached.sum()), failed + int(step.failed.sum())
        x = step.state[~(step.reached | step.failed)]
    return reached / paths, failed / paths


def assert_agrees(rate: float, probability: float, paths: int, other_paths: float = math.inf):
    """Within three standard errors of a probability, or of a rate estimated from `other_paths`."""
    assert abs(rate - probability) <= 3 * math.sqrt(probability * (1 - probability) * (1 / paths + 1 / other_paths))


@pytest.mark.parametrize(("start", "substeps"), [(-1.0, 1), (0.0, 1), (1.0, 1), (1.0, 3)])
def test_bridge_hits_with_the_exact_probability(start, substeps):
    problem, paths = Reach1D(), 200_000
    exact = problem.exact_value(torch.tensor(2.0, dtype=torch.float64), torch.tensor([start], dtype=torch.float64))
    rate, _ = rates(Simulator(problem, 0.1, substeps, "bridge"), [start], [1.0], 20, paths)
    assert_agrees(rate, exact.item(), paths)


@pytest.mark.parametrize("start", [-1.0, 0.0, 1.0])
def test_endpoint_hits_like_the_process_watched_every_dt(start):
    paths = 200_000
    exact = np.interp(start, GOLDEN["x_discrete"], GOLDEN["value_discrete"][-1])
    rate, _ = rates(Simulator(Reach1D(), 0.1, 1, "endpoint"), [start], [1.0], 20, paths)
    assert_agrees(rate, exact, paths)


def test_bridge_leaves_an_interval_with_the_exact_probability():
    """Brownian motion from 0 in (-1, 1): P(survive t) = 4/pi sum (-1)^k/(2k+1) exp(-(2k+1)^2 pi^2 t/8).

    Each face is exact, both at once nearly so: from a step of 0.05 the chance to cross both is below 1e-8.
    """
    paths = 200_000
    exact = (
        4 / math.pi * sum((-1) ** k / (2 * k + 1) * math.exp(-((2 * k + 1) ** 2) * math.pi**2 / 8) for k in range(9))
    )
    reached, failed = rates(Simulator(Safety1D(), 0.05), [0.0], [0.0], 20, paths)
    assert reached == 0
    assert_agrees(failed, 1 - exact, paths)


class Slanted(FullNoise):
    """Constant drift and full sigma, reach an oblique half-plane: exact for the bridge at any step."""

    sigma = ((0.8, 0.3, 0.0), (-0.4, 0.5, 0.6))

    def __init__(self):
        super().__init__(2, 1, 3)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u * x.new_tensor([1.0, 0.5])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor(self.sigma).expand(*x.shape[:-1], 2, 3)

    def target_level(self, x: Tensor) -> Tensor:
        return 2 - 3 * x[..., 0] - x[..., 1]

    def avoid_level(self, x: Tensor) -> Tensor:
        return torch.full_like(x[..., 0], torch.inf)


def test_bridge_is_exact_for_a_full_sigma_and_an_oblique_face():
    """The level is a Brownian motion with drift: reflection formula with its own drift and deviation."""
    problem, paths, horizon = Slanted(), 200_000, 1.5
    slope = torch.tensor([3.0, 1.0], dtype=torch.float64)
    deviation = (slope @ torch.tensor(Slanted.sigma, dtype=torch.float64)).norm().item()
    drift, distance = 0.6 * 3.5 / deviation, 2 / deviation

    def cdf(z: float) -> float:
        return math.erfc(-z / math.sqrt(2)) / 2

    root = math.sqrt(horizon)
    exact = cdf((drift * horizon - distance) / root) + math.exp(2 * drift * distance) * cdf(
        (-drift * horizon - distance) / root
    )
    rate, _ = rates(Simulator(problem, 0.5), [0.0, 0.0], [0.6], 3, paths)
    assert_agrees(rate, exact, paths)


class Window(Reach1D):
    """Reach x >= 1 at a time y in [0.2, 0.5]: an intersection whose second face moves without noise."""

    horizon = 0.5
    states = Box([-2.0, 0.0], [2.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([u, torch.ones_like(u)], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[1.0], [0.0]]).expand(*x.shape[:-1], 2, 1)

    def target_level(self, x: Tensor) -> Tensor:
        return self.target_constraints(x).amax(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return torch.stack([1 - x[..., 0], 0.2 - 1e-9 - x[..., 1]], -1)


def test_bridge_is_exact_for_an_intersection_whose_other_constraints_hold_at_both_ends():
    paths = 200_000
    x = np.linspace(-6, 6, 20_001)
    density = np.exp(-((x - 0.1) ** 2) / 0.4) / math.sqrt(0.4 * math.pi)  # at y = 0.2, under u = 0.5
    d, t = torch.tensor(1 - x).clamp(min=0), 0.3
    cdf = torch.special.ndtr
    later = cdf((0.5 * t - d) / t**0.5) + torch.exp(d) * cdf((-0.5 * t - d) / t**0.5)
    exact = np.trapezoid(density * later.numpy(), x)
    rate, _ = rates(Simulator(Window(), 0.1), [0.0, 0.0], [0.5], 5, paths)
    assert_agrees(rate, exact, paths)


def test_the_bridge_sees_a_target_with_corners():
    """Against steps of 2e-3 checked at their ends, the target grown by 0.5826 sqrt(h), which removes the O(sqrt(h)) of
    such checks (Broadie, Glasserman and Kou 1997). With 60,000 paths they give 0.526 +- 0.002. With one step, two and
    ten the bridge has 0.521, 0.525 and 0.530, all +- 0.002."""

    class Grown(Corner):
        def target_constraints(self, x):
            return super().target_constraints(x) - 0.5826 * math.sqrt(0.002)

    paths, start, u = 8_000, [1.0, 0.0], [-0.5, 0.0]
    fine, _ = rates(Simulator(Grown(), 0.1, 50, "endpoint"), start, u, 5, paths)
    bridges = [
        rates(Simulator(Corner(), 0.1, count, "bridge"), start, u, 5, paths, seed=count)[0] for count in (1, 2, 10)
    ]
    endpoint, _ = rates(Simulator(Corner(), 0.1, 10, "endpoint"), start, u, 5, paths, seed=1)
    sampling = 3 * math.sqrt(2 * fine * (1 - fine) / paths)
    assert all(abs(bridge - fine) <= 0.003 + sampling for bridge in bridges)
    assert endpoint < fine - 0.01 - sampling


def test_a_path_that_shows_both_exits_has_failed():
    class Both(Reach1D):
        def avoid_level(self, x):
            return 3.0 - x[..., 0]

    x = torch.full((1000, 1), 1.99)
    step = Simulator(Both(), 0.1).step(x, torch.ones_like(x), torch.Generator().manual_seed(0))
    assert not (step.reached & step.failed).any()
    beyond = step.state[:, 0] >= 3.0
    assert step.failed[beyond].all()
    assert step.reached.any()


@pytest.mark.parametrize("crossing", ["bridge", "endpoint"])
def test_a_path_that_ended_in_a_substep_is_held(crossing):
    simulator, rng = Simulator(Reach1D(), 0.5, 50, crossing), torch.Generator().manual_seed(0)
    x = torch.full((2000, 1), 1.5)
    step = simulator.step(x, torch.ones_like(x), rng)
    # Ended paths stay within a sub-step's reach of the face, the others have moved on and are outside the target.
    assert (step.state[step.reached, 0] - 2).abs().max() < 6 * math.sqrt(0.01)
    assert (step.state[~step.reached, 0] < 2).all()
    assert 0.3 < step.reached.float().mean() < 0.9


@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_one_step_mean_is_the_generator_to_first_order(problem):
    """(E[phi(tau - h, x')] - phi(tau, x))/h -> L phi: the error falls with h, within three standard errors."""
    torch.manual_seed(0)
    critic = Critic(problem, (9, 7), action_input=True).double()
    for parameter in critic.parameters():
        torch.nn.init.normal_(parameter, std=0.7)
    tau, x, action, u = (entry.double() for entry in points(problem, 3))  # three points, many paths
    tau, paths, errors = 0.2 * problem.horizon + 0.8 * tau, 50_000, []
    exact = generator(critic.at(action), problem, tau, x, u)
    for h in (4e-3 * problem.horizon, 1e-3 * problem.horizon):
        simulator, rng = Simulator(problem, h, 1, "endpoint"), torch.Generator().manual_seed(1)
        start = x.repeat(paths, 1)
        moved = simulator.step(start, u.repeat(paths, 1), rng).state
        phi = critic.at(action.repeat(paths, 1))
        change = (phi(tau.repeat(paths) - h, moved) - phi(tau.repeat(paths), start)).reshape(paths, -1) / h
        # Control variate: the linear part of the noise has mean zero.
        noise = (moved - start - problem.drift(start, u.repeat(paths, 1)) * h).reshape(paths, len(x), -1)
        inputs = x.clone().requires_grad_()
        (slope,) = torch.autograd.grad(critic.at(action)(tau, inputs).sum(), inputs)
        change = change - (noise * slope).sum(-1) / h
        errors.append(((change.mean(0) - exact).abs(), 3 * change.std(0) / math.sqrt(paths)))
    for _, sampling in errors:
        assert (sampling < 0.1 * exact.abs().max()).all()
    (coarse, coarse_sampling), (fine, fine_sampling) = errors
    assert (fine <= coarse / 4 * 1.5 + coarse_sampling / 2 + fine_sampling + 1e-3 * exact.abs().max()).all()


class Pendulum(ReachAvoidProblem):
    """A free oscillation of 1 rad/s with little noise; reach a speed or an angle that no path has."""

    horizon = 20 * math.pi
    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([x[..., 1], -x[..., 0]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return x.new_tensor([[0.0], [1e-3]]).expand(*x.shape[:-1], 2, 1)

    def target_level(self, x: Tensor) -> Tensor:
        return 100 - x.norm(dim=-1)


@pytest.mark.parametrize(("crossing", "growth"), [("bridge", 0.0), ("endpoint", 1.0)])
def test_an_oscillation_keeps_its_energy_in_steps_of_second_order(crossing, growth):
    """In 10 periods and 800 steps: Euler steps multiply the amplitude by exp(w^2 h T/2) to first order in h."""
    problem, rng = Pendulum(), torch.Generator().manual_seed(0)
    simulator = Simulator(problem, problem.horizon / 800, 1, crossing)
    x = torch.tensor([[1.0, 0.0]], dtype=torch.float64).repeat(500, 1)
    for _ in range(800):
        x = simulator.step(x, torch.zeros_like(x[:, :1]), rng).state
    logarithm = x.norm(dim=-1).log().mean().item()
    # Second-order steps multiply it by exp(w^4 h^3 T/8), and noise of the variance 1e-6 T adds less than 1e-4.
    assert logarithm == pytest.approx(growth * problem.horizon**2 / 800 / 2, rel=0.1, abs=5e-3)


class Spring(Reach1D):
    """dx = -x^power dt + dW, whose stationary density is proportional to exp(-2 x^(power + 1) / (power + 1))."""

    horizon = 8.0
    states = Box([-8.0], [8.0])
    objective = "invariance"

    def __init__(self, power: int):
        self.power = power

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return -(x**self.power)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.ones_like(x).unsqueeze(-1)

    def avoid_level(self, x: Tensor) -> Tensor:
        return 8 - x[..., 0].abs()


@pytest.mark.parametrize(("power", "variance"), [(1, 0.5), (3, math.sqrt(2) * math.gamma(0.75) / math.gamma(0.25))])
def test_a_spring_has_its_stationary_variance(power, variance):
    """With 10 steps in a unit of time, where noise that is added after the drift makes the variances 10 % too large.

    Steps of second order make that of the linear spring 0.3 % too small, by the recursion of the variance. The standard
    error of the variance of 100,000 paths is below 0.5 %.
    """
    problem, rng = Spring(power), torch.Generator().manual_seed(0)
    simulator, x = Simulator(problem, 0.1, 1), torch.zeros(100_000, 1)
    for _ in range(80):
        x = simulator.step(x, torch.zeros_like(x), rng, crossings=False).state
    assert x.square().mean().item() == pytest.approx(variance, rel=0.03)


class Explosion(Reach1D):
    """dx = x^3 dt leaves for infinity within 1/(2 x^2): 0.02 s from -5, and 1/8 s from -2."""

    states = Box([-2.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return x**3


class Survival(Explosion):
    objective = "invariance"


@pytest.mark.parametrize("crossing", ["bridge", "endpoint"])
@pytest.mark.parametrize("problem", [Explosion(), Survival()], ids=name)
def test_a_path_that_leaves_for_infinity_fails(problem, crossing):
    x = torch.tensor([[-5.0], [-1e30], [0.0]])
    step = Simulator(problem, 0.2, 20, crossing).step(x, torch.zeros_like(x), torch.Generator().manual_seed(0))
    assert step.failed.tolist() == [True, True, False]
    assert not step.reached.any()
    assert step.state.isfinite().all()
    assert step.noise.isfinite().all()


class Undefined(Reach1D):
    """Reach x <= 0; neither drift nor noise has a value there."""

    states = Box([0.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return -x.sqrt()

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.1 * x.sqrt().unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return x[..., 0]


def test_physics_without_a_value_in_the_target_is_not_asked_there():
    """x^1/2 falls at 1/2 per s, so that 1e-3 is empty after 0.063 s; the end of the step lies below 0."""
    x = torch.full((1000, 1), 1e-3)
    step = Simulator(Undefined(), 0.4, 2).step(x, torch.zeros_like(x), torch.Generator().manual_seed(0))
    assert step.reached.all()
    assert step.state.isfinite().all()
    assert step.noise.isfinite().all()


def test_the_gradient_of_a_step_without_noise_is_finite_where_its_end_is_undefined():
    x, u = torch.tensor([[1e-3], [1.0]]), torch.zeros(2, 1, requires_grad=True)

    class Filled(Undefined):
        def drift(self, x: Tensor, u: Tensor) -> Tensor:
            return super().drift(x, u) + u

    (slope,) = torch.autograd.grad(Simulator(Filled(), 0.4, 1).flow(x, u).sum(), u)
    # The first is a step of Euler's. The second has h/2 times the slope of the drift, -1/(2 sqrt(y)), at y = 0.6.
    assert slope[0].item() == pytest.approx(0.4)
    assert slope[1].item() == pytest.approx(0.4 * (1 - 0.4 / (4 * math.sqrt(0.6))))


@pytest.mark.parametrize("crossing", ["bridge", "endpoint"])
def test_the_noise_of_a_step_is_that_of_the_path_until_it_ended(crossing):
    """Without drift, a path has moved by its noise alone."""

    class Walk(Reach1D):
        def drift(self, x: Tensor, u: Tensor) -> Tensor:
            return torch.zeros_like(x)

    x = torch.full((1000, 1), 1.8, dtype=torch.float64)
    step = Simulator(Walk(), 0.5, 10, crossing).step(x, torch.zeros_like(x), torch.Generator().manual_seed(0))
    assert 100 < step.reached.sum() < 900
    torch.testing.assert_close(step.noise, step.state - x)


def test_steps_of_own_length():
    problem, rng = Reach1D(), torch.Generator().manual_seed(0)
    x = torch.full((100_000, 1), -1.0, dtype=torch.float64)
    dt = torch.linspace(0.01, 0.1, len(x), dtype=torch.float64)
    moved = Simulator(problem, 0.1).step(x, torch.zeros_like(x), rng, dt=dt).state
    z = (moved - x)[:, 0] / dt.sqrt()
    for half in (z[:50_000], z[50_000:]):
        assert half.var().item() == pytest.approx(1, abs=3 * math.sqrt(2 / len(half)))


def test_same_generator_state_same_step():
    problem = FullNoise(8, 2, 3)
    _, x, _, u = points(problem, 50)
    first, second, other = (
        Simulator(problem).step(x, u, torch.Generator().manual_seed(seed)).state for seed in (0, 0, 1)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


def test_a_face_without_noise_is_not_crossed_between_the_ends():
    class Quiet(Reach1D):
        states, controls = Box([-2.0, -1.0], [2.0, 1.0]), Box([-1.0, -1.0], [1.0, 1.0])

        def diffusion(self, x, u):
            return x.new_tensor([[0.0], [1.0]]).expand(*x.shape[:-1], 2, 1)

    x = torch.tensor([[1.999, 0.0], [1.9, 0.0]]).repeat(500, 1)
    u = torch.tensor([[-1.0, 0.0], [1.0, 0.0]]).repeat(500, 1)
    step = Simulator(Quiet(), 0.1001).step(x, u, torch.Generator().manual_seed(0))
    assert not step.reached[::2].any()
    assert step.reached[1::2].all()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"dt": 2.5}, r"dt: expected 0 < dt <= horizon = 2.0, got 2.5"),
        ({"dt": 0.0}, r"dt: .* got 0.0"),
        ({"substeps": 0}, r"substeps: expected an integer >= 1, got 0"),
        ({"substeps": 1.5}, r"substeps: .* got 1.5"),
        ({"crossing": "tunnel"}, r"crossing: expected 'bridge' or 'endpoint', got 'tunnel'"),
    ],
)
def test_wrong_steps_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        Simulator(Reach1D(), **kwargs)


def test_a_part_of_a_larger_tensor_is_simulated_in_compiled_code(monkeypatch):
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))
    x = torch.linspace(-1, 1, 128)[:64].reshape(64, 1)
    eager, compiled = (
        Simulator(Reach1D(), 0.1, compile=compile).step(x, torch.zeros_like(x), torch.Generator().manual_seed(0))
        for compile in (False, True)
    )
    torch.testing.assert_close(compiled, eager)


@pytest.mark.parametrize("problem", [Reach1D(), ZermeloBoat()], ids=["one matrix of noise", "walls and a rock"])
def test_a_compiled_simulator_draws_the_same_random_numbers(problem, monkeypatch):
    """The compiler's front end alone is used; what it makes of it is compared in single precision."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager", fullgraph=True))
    x = sample_interior(problem, problem.states, 500, torch.Generator().manual_seed(0), torch.float32)
    u = problem.controls.sample(500, torch.Generator().manual_seed(1))
    eager, compiled = (
        Simulator(problem, 0.1, 3, compile=compile).step(x, u, torch.Generator().manual_seed(2))
        for compile in (False, True)
    )
    torch.testing.assert_close(compiled.state, eager.state)
    assert torch.equal(compiled.reached, eager.reached)
    assert torch.equal(compiled.failed, eager.failed)
    assert (eager.reached | eager.failed).any()


def test_physics_that_cannot_be_compiled_run_eagerly_and_the_line_is_named():
    class Branching(Reach1D):
        def drift(self, x, u):
            return u if x.sum().item() > 0 else 1.0 * u

    x, u = torch.full((5, 1), 0.5), torch.zeros(5, 1)
    simulator = Simulator(Branching(), 0.1, compile=True)
    with pytest.warns(
        UserWarning, match=r"the simulator runs eagerly, which is slower: .*test_simulator\.py, line \d+"
    ):
        step = simulator.step(x, u, torch.Generator().manual_seed(0))
    assert torch.equal(step.state, Simulator(Branching(), 0.1).step(x, u, torch.Generator().manual_seed(0)).state)
