"""Periodic coordinates: the circle is exact in networks, operator, simulator and runs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracles import Circle, FullNoise, Winding, name, points, random_solution

import pirl_rl
from pirl_rl import ReachAvoidProblem
from pirl_rl.cubature import continued_value
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.evaluation.trajectories import closed_loop
from pirl_rl.layers import Periodic
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.operators import generator
from pirl_rl.problems import Reach1D
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


def uniform(low: float, high: float, *shape: int):
    return low + (high - low) * torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def still(tau, x):
    return torch.zeros_like(x)


def shifted(problem, x, turns: int):
    """The same states (N, n), with periodic coordinates outside their period."""
    x, box = x.clone(), problem.states
    for axis in box.periodic:
        x[:, axis] += turns * (box.high[axis] - box.low[axis])
    return x


def test_inputs_are_sine_and_cosine_of_the_angle():
    z = uniform(-3, 3, 50, 4)
    y = Periodic(4, [1, 2]).double()(z)
    angle = math.pi * (z[:, 1:3] + 1)
    expected = torch.cat([z[:, :1], torch.sin(angle), z[:, 3:], torch.cos(angle)], -1)
    # The layer is made in single precision, in which pi has an error of 1e-7.
    torch.testing.assert_close(y, expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("scaling", [None, Box([-1.0, -0.1, -1.0], [1.0, 0.1, 1.0])])
def test_critic_takes_scaled_coordinates_and_waves(scaling):
    """Whatever the box for scaling, the period is that of the problem."""
    problem = Winding()
    critic, box = Critic(problem, (5,), root_time=False, scaling=scaling), problem.states
    tau, x, action, _ = points(problem, 20)
    z = (scaling or box).normalize(x)
    angle = 2 * math.pi * (x[:, 1] - box.low[1]) / (box.high[1] - box.low[1])
    columns = (2 * tau / problem.horizon - 1, z[:, 0], torch.sin(angle), z[:, 2], torch.cos(angle))
    expected = critic.layers[2:](torch.stack(columns, -1))
    torch.testing.assert_close(critic(tau.unsqueeze(-1), x, action), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("network", [Actor, Critic])
def test_networks_without_periodic_axes_have_the_layers_that_they_had(network):
    extra = [] if network is Actor else ["layers.2.weight", "layers.2.bias"]
    names = set(network(Reach1D(), (4,)).state_dict())
    first = 0 if network is Actor else 1
    assert {f"layers.{first}.scale", f"layers.{first}.shift", f"layers.{first + 1}.weight", *extra} <= names
    assert not any("frequency" in key for key in names)


@pytest.mark.parametrize("problem", [Circle(), Winding()], ids=name)
@pytest.mark.parametrize("turns", [-2, -1, 1])
def test_solution_is_periodic(problem, turns):
    """V, gradient, residual and policy, to the rounding of pi in single precision, in which layers are made."""
    solution = random_solution(problem)
    tau, x, _, _ = (entry.double() for entry in points(problem, 200))
    for method in (solution.value, solution.raw_value, solution.gradient, solution.residual, solution.policy):
        here, there = method(tau, x), method(tau, shifted(problem, x, turns))
        assert here.std() > 1e-3
        torch.testing.assert_close(there, here, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("problem", [Circle(), Winding()], ids=name)
def test_networks_are_periodic_without_the_help_of_wrap(problem):
    """The critic and L^u V outside the period, where the problem's f and sigma are those of the state inside."""
    solution = random_solution(problem)
    tau, x, action, u = (entry.double() for entry in points(problem, 200))
    there = shifted(problem, x, 1)
    torch.testing.assert_close(solution.actor(tau[:, None], there), solution.actor(tau[:, None], x), rtol=0, atol=1e-6)

    class Lifted(type(problem)):
        def drift(self, x, u):
            return super().drift(self.states.wrap(x), u)

        def diffusion(self, x, u):
            return super().diffusion(self.states.wrap(x), u)

    value, lifted = solution.critic.at(action), Lifted()
    torch.testing.assert_close(value(tau, there), value(tau, x), rtol=0, atol=1e-6)
    here = generator(value, lifted, tau, x, u)
    assert here.abs().max() > 0.1
    # Scales of the first layer are rounded to single precision, second derivatives multiply that by up to 100.
    torch.testing.assert_close(generator(value, lifted, tau, there, u), here, rtol=1e-5, atol=1e-5)


def test_gradients_reach_the_parameters_through_the_second_derivative_of_the_waves():
    """dX = 0.8 dW on the circle: L V = -d_tau V + 0.32 d_xx V, against nested autograd, parameter by parameter."""
    problem = Circle()
    critic = random_solution(problem).critic
    tau, x, action, u = (entry.double() for entry in points(problem, 50))

    class Still(Circle):
        def diffusion(self, x, u):
            return 0 * super().diffusion(x, u)

    second = generator(critic.at(action), problem, tau, x, u) - generator(critic.at(action), Still(), tau, x, u)
    inputs = x.clone().requires_grad_()
    (slope,) = torch.autograd.grad(critic.at(action)(tau, inputs).sum(), inputs, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.sum(), inputs, create_graph=True)
    oracle = 0.5 * 0.8**2 * curvature.squeeze(-1)
    torch.testing.assert_close(second[0], oracle, rtol=1e-9, atol=1e-10)
    parameters = [parameter for parameter in critic.parameters() if parameter.requires_grad]
    ours, theirs = (torch.autograd.grad(result.square().sum(), parameters) for result in (second, oracle))
    for mine, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-8, atol=1e-8 * float(expected.abs().max()))
    assert all(gradient.abs().max() > 0 for gradient in theirs)


def test_the_heat_kernel_on_the_circle_has_no_residual():
    """exp(-D tau) cos(a), with the angle a = 2 pi (x - low)/4 and D = 0.32 (2 pi/4)^2, solves L V = 0. A network of one
    wave is cos(a), so that its drift is -D cos(a).
    """
    problem = Circle()
    critic = Critic(problem, (), root_time=False).double()
    dense = critic.layers[-1]
    with torch.no_grad():
        dense.weight.copy_(torch.tensor([[0.0, 0.0, 1.0]]))
        dense.bias.zero_()
    x = uniform(-10, 10, 100, 1)
    angle, rate = 2 * math.pi * (x[:, 0] + 1) / 4, 0.32 * (math.pi / 2) ** 2
    tau, u = torch.ones(100, dtype=torch.float64), torch.zeros(100, 1, dtype=torch.float64)
    torch.testing.assert_close(critic.at(u)(tau, x), torch.cos(angle), rtol=0, atol=2e-6)
    torch.testing.assert_close(generator(critic.at(u), problem, tau, x, u), -rate * torch.cos(angle), rtol=0, atol=2e-6)


@pytest.mark.parametrize("substeps", [1, 4])
def test_wrapping_changes_no_path(substeps):
    """The same noise with and without periodic axes: equal modulo the period, with the same exits."""
    wrapping, plain = Winding(), FullNoise(3, 2, 2)
    x = uniform(-0.5, 1.0, 2_000, 3)
    ends = []
    for problem in (wrapping, plain):
        simulator, rng, state = Simulator(problem, 0.3, substeps), torch.Generator().manual_seed(0), x.clone()
        state[:, 1] = 5.1
        exits = torch.zeros(2, len(x), dtype=torch.bool)
        for _ in range(3):
            step = simulator.step(state, torch.ones(len(x), 2, dtype=x.dtype), rng)
            state, exits = step.state, exits | torch.stack([step.reached, step.failed])
        ends.append((state, exits))
    (wrapped, exits), (free, same_exits) = ends
    assert torch.equal(exits, same_exits)
    assert exits.any(-1).all()
    torch.testing.assert_close(wrapped[:, [0, 2]], free[:, [0, 2]], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(wrapped, wrapping.states.wrap(free), rtol=1e-12, atol=1e-12)
    outside = (free - wrapped)[:, 1].abs() > 1
    assert 0.1 < outside.double().mean() < 0.9


def test_noise_free_flow_stays_in_the_period():
    problem = Winding()
    x = uniform(-1, 2, 200, 3)
    x[:, 1] = 5.1
    moved = Simulator(problem, 0.3, 3).flow(x, torch.ones(200, 2, dtype=x.dtype))
    free = Simulator(FullNoise(3, 2, 2), 0.3, 3).flow(x, torch.ones(200, 2, dtype=x.dtype))
    torch.testing.assert_close(moved, problem.states.wrap(free), rtol=1e-12, atol=1e-12)
    assert ((free - moved)[:, 1].abs() > 1).any()
    whole = torch.compile(Simulator(problem, 0.3, 3).flow, backend="eager", fullgraph=True)
    assert torch.equal(whole(x, torch.ones(200, 2, dtype=x.dtype)), moved)


def test_exit_of_an_arc_has_the_exact_probability():
    """From five places, some of which reach the arc over the seam first; three standard errors."""
    problem, rollouts = Circle(), 20_000
    x = torch.tensor([[0.7], [1.5], [2.5], [2.95], [-0.7]], dtype=torch.float64)
    found = monte_carlo(problem, still, 1.5, x, rollouts, dt=0.075).probability
    exact = problem.exact_value(torch.full((5,), 1.5, dtype=torch.float64), x)
    assert ((found - exact).abs() <= 3 * (exact * (1 - exact) / rollouts).sqrt()).all()
    # A path that could not cross the seam would exit from x = 2.5 at distance 2 alone: about 0.04.
    assert exact[2] > 0.2


def test_monte_carlo_and_paths_start_anywhere():
    problem = Circle()
    x = torch.tensor([[0.2], [0.7], [2.5]], dtype=torch.float64)
    estimates = [monte_carlo(problem, still, 1.0, x + 4 * k, 200, dt=0.1) for k in (0, 1, -3)]
    for other in estimates[1:]:
        for one, two in zip(estimates[0][:3], other[:3], strict=True):
            assert torch.equal(one, two)
    assert estimates[0].probability[0] == 1
    paths = [
        closed_loop(Simulator(problem), still, torch.ones(3).double(), start, torch.Generator().manual_seed(0))
        for start in (x, x - 8)
    ]
    torch.testing.assert_close(paths[0].state, paths[1].state, rtol=1e-12, atol=1e-12)
    assert ((paths[0].state >= -1) & (paths[0].state < 3)).all()


def test_a_run_answers_outside_the_period_as_inside(tmp_path):
    settings = {"updates": 20, "compile": False, "debug": "default", "env.num_envs": 32}
    settings |= {"collector": {"frames_per_batch": 64, "warmup_frames": 64}}
    settings |= {"evaluation": {"during": [], "final": []}, "figures": False}
    pirl_rl.train(Circle(), folder=tmp_path / "run", **settings)
    run = pirl_rl.load_run(tmp_path / "run", problem=Circle())
    x = np.array([[0.2], [0.8], [2.0], [-0.9]])
    for method in (run.value, run.gradient, run.residual, run.policy):
        assert np.allclose(method(1.0, x), method(1.0, x + 4), atol=1e-5)
    assert np.array_equal(run.reach_avoid_set(0.5, 1.0)(x), run.reach_avoid_set(0.5, 1.0)(x - 8))
    one, other = (run.monte_carlo(1.0, states, rollouts=50) for states in (x, x + 4))
    assert np.array_equal(one.probability, other.probability)
    assert one.probability[0] == 1
    paths, others = (run.simulate(1.0, states) for states in (x, x + 4))
    assert np.allclose(paths.state, others.state, atol=1e-5)
    assert ((paths.state >= -1) & (paths.state < 3)).all()


@pytest.mark.slow
def test_a_short_training_learns_the_exit_of_an_arc(tmp_path):
    """Measured: mean square error 6e-4 outside the arc; without a periodic input the ends of a period would differ."""
    run = pirl_rl.train(Circle(), folder=tmp_path / "run", updates=2000, compile=False, evaluation={"final": ["exact"]})
    x = torch.linspace(0.5, 3.5, 301, dtype=torch.float64).unsqueeze(-1)
    tau = torch.full((301,), 2.0, dtype=torch.float64)
    error = run.value(2.0, x) - run.problem.exact_value(tau, x)
    assert error.square().mean() < 2e-3
    seam = torch.tensor([[3 - 1e-5], [3 + 1e-5]])
    torch.testing.assert_close(*run.solution.raw_value(torch.full((2,), 2.0), seam), rtol=0, atol=1e-4)


def test_levels_beyond_the_period_are_those_within_it():
    """A tangent next to the seam has its zero beyond it, where the level as written knows nothing of the period."""
    circle = Box([-1.0, 0.0], [1.0, 1.0], periodic=[0])
    level = circle.within_period(lambda x: x[..., 0].abs())
    x = torch.tensor([[0.5, 9.0], [1.25, 9.0], [-1.75, 9.0]])
    assert level(x).tolist() == [0.5, 0.75, 0.25]


class Lighthouse(ReachAvoidProblem):
    """A beam on a circle, whose target is written for angles in [0, 2 pi) alone, with noise that the control sets."""

    horizon = 1.0
    states, controls = Box([0.0], [2 * math.pi], periodic=[0]), Box([0.0], [1.0])

    def drift(self, x, u):
        return torch.sin(x)

    def diffusion(self, x, u):
        return u.unsqueeze(-1)

    def target_level(self, x):
        return torch.minimum(x[..., 0], 2 * math.pi - x[..., 0]) - 0.3


def test_the_continuation_into_a_set_knows_the_period():
    """V inside of the target is 2 - V at the mirrored state, also where that lies beyond the end of the period."""
    torch.manual_seed(0)
    problem = Lighthouse()
    solution = Solution(problem, Actor(problem), stack([Critic(problem)]))
    x = torch.linspace(0.0, 6.2, 50).unsqueeze(-1)
    tau = torch.full((50,), 0.5)
    inside = continued_value(solution, tau, x)
    for turns in (-1, 1):
        torch.testing.assert_close(continued_value(solution, tau, x + turns * 2 * math.pi), inside, atol=1e-5, rtol=0)
    mirrored = 0.6 - x[x[:, 0] < 0.3]
    own = solution.value(tau[: len(mirrored)], mirrored)
    torch.testing.assert_close(inside[: len(mirrored)], 2 - own, atol=1e-5, rtol=0)
