"""Ascent to the best control of the Hamiltonian, and the actor rule that imitates it."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.kinds import Bicycle, Gusty, Investor, Loiter, Sprint, TwoHarbours
from pirl_rl import Box, ReachAvoidProblem, action_values
from pirl_rl.action_values import hamiltonian, value_ahead
from pirl_rl.actor_rules import BestControl, Hamiltonian
from pirl_rl.ascent import ascend, improved
from pirl_rl.assembly import make_trainer
from pirl_rl.automatic import choose_actor
from pirl_rl.building import build
from pirl_rl.commands.composition import compose
from pirl_rl.cubature import Face, absorbing_faces, continued_value, expected_ahead, free_step, time_to_exit
from pirl_rl.errors import ArgumentError, ConfigError
from pirl_rl.layers import LogLevels
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.problems import PlanarQuadrotor, Reach1D, VehicleDrift, VehicleDrift3
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution
from pirl_rl.structure import controlled_channels, has_controlled_noise
from pirl_rl.switching import COARSE, JOINT, actor_choices, candidate_controls, control_levels, switching


class Steered(ReachAvoidProblem):
    """dX = (u + 0.1 X) dt + sigma dW in the plane, with noise that grows with u_2 if `controlled`."""

    horizon = 2.0
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.0, -2.0, -1.0], [1.0, 1.0, 3.0])

    def __init__(self, controlled: bool = False):
        super().__init__()
        self.controlled = controlled

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u[..., :2] + u[..., 2:] * x.flip(-1) + 0.1 * x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        scale = 0.5 + 0.2 * u[..., 1] if self.controlled else torch.full_like(x[..., 0], 0.5)
        return scale[..., None, None] * torch.eye(2).to(x)

    edge = 1.0

    def target_level(self, x: Tensor) -> Tensor:
        return self.edge - x[..., 0]


class Heading(Steered):
    """dX = (cos u_1, sin u_1) dt + sigma dW: the first control is the heading, all around."""

    controls = Box([-math.pi, 0.0, 0.0], [math.pi, 1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([u[..., 0].cos(), u[..., 0].sin()], -1)


class Shaken(Steered):
    """dX = 0.1 X dt + (0.3 + u_1^2) dW: the first control has the same noise at both bounds, and no drift."""

    controls = Box([-1.0, 0.0, 0.0], [1.0, 1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.1 * x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.3 + u[..., 0].square())[..., None, None] * torch.eye(2).to(x)


def solution_of(problem: ReachAvoidProblem, seed: int = 0) -> Solution:
    torch.manual_seed(seed)
    return Solution(problem, Actor(problem), stack([Critic(problem, output="Sigmoid")]))


def points(problem: ReachAvoidProblem, count: int = 64) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(1)
    return problem.horizon * torch.rand(count, generator=rng), problem.states.sample(count, rng)


@pytest.mark.parametrize("controlled", [False, True])
def test_the_hamiltonian_is_the_part_of_the_residual_that_depends_on_the_control(controlled):
    problem = Steered(controlled)
    assert has_controlled_noise(problem) == controlled
    solution, (tau, x) = solution_of(problem), points(problem)
    objective = hamiltonian(solution, tau, x, controlled)
    one, other = (2 * torch.rand(len(x), 3) - 1 for _ in range(2))
    residuals = [solution.residual(tau, x, problem.controls.denormalize(action)) for action in (one, other)]
    assert torch.allclose(objective(one) - objective(other), residuals[0] - residuals[1], atol=1e-5)


class Quadratic:
    """V = tau + x' M x / 2 in place of learned networks."""

    M = torch.tensor([[0.3, 0.1], [0.1, -0.2]])

    def __init__(self, problem: ReachAvoidProblem):
        self.problem = problem

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        return tau + (x @ self.M * x).sum(-1) / 2

    def gradient(self, tau: Tensor, x: Tensor) -> Tensor:
        return x @ self.M


def test_a_hamiltonian_in_parts_is_the_whole(monkeypatch):
    """Sigma (8, 50, n, w) of eight actions at each of 50 points has at most 400 entries at once, one point or a few."""
    largest = []

    class Counted(Steered):
        def diffusion(self, x, u):
            sigma = super().diffusion(x, u)
            largest.append(sigma.numel())
            return sigma

    problem = Counted(controlled=True)
    solution, (tau, x) = solution_of(problem), points(problem, 50)
    action = 2 * torch.rand(8, 50, problem.controls.dim) - 1
    whole = hamiltonian(solution, tau, x, True)(action)
    monkeypatch.setattr(action_values, "CHUNK_ENTRIES", 400)
    largest.clear()
    parts = hamiltonian(solution, tau, x, True)(action)
    torch.testing.assert_close(parts, whole)
    assert max(largest) <= 400


def test_the_cubature_is_exact_for_a_quadratic_value():
    """E V = tau - h + m' M m / 2 + h Tr(sigma' M sigma) / 2 with m = x + f h, where h is at most tau."""
    problem, (tau, x) = Steered(controlled=True), points(Steered(), 20)
    problem.edge = 100.0
    action = 2 * torch.rand(3, 20, 3) - 1
    u, h = problem.controls.denormalize(action), tau.clamp(max=0.3)
    y = x.expand(3, -1, -1)
    mean, sigma = y + problem.drift(y, u) * h.unsqueeze(-1), problem.diffusion(y, u)
    trace = (sigma * (Quadratic.M @ sigma)).sum((-2, -1))
    expected = Quadratic(problem).value(tau - h, mean) + h * trace / 2
    faces = absorbing_faces(problem, x)
    objective = expected_ahead(Quadratic(problem), tau, x, faces, 0.3, range(sigma.shape[-1]))  # type: ignore[arg-type]
    found = objective(action)
    assert torch.allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("channels", [[2], [1, 2], [0, 1, 2], [0, 1, 2, 3]])
@pytest.mark.parametrize("near", [False, True])
def test_the_cubature_has_the_fourth_moments_of_few_columns_beside_the_avoid_set(channels, near):
    """E (s W)^4 = 3 s^4 h^2 for each coordinate, which has a column of its own, of strength s.

    Points at +- sqrt(c h) have c s^4 h^2, with c = 3 beside B for one and two columns, and else c = w.
    """

    class Apart(ReachAvoidProblem):
        """dx_k = (1 + k + u) dW_k in four dimensions."""

        horizon = 1.0
        states, controls = Box([-1.0] * 4, [1.0] * 4), Box([-0.5], [0.5])

        def drift(self, x, u):
            return torch.zeros_like(x)

        def diffusion(self, x, u):
            return torch.diag_embed(torch.arange(1.0, 5.0).to(x) + u)

        def target_level(self, x):
            return 100 - x[..., 0]

    class Quartic:
        def __init__(self, problem):
            self.problem = problem

        def value(self, tau, x):
            return x.pow(4).sum(-1)

    problem, h = Apart(), 0.1
    x, action = torch.zeros(1, 4, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    slope = torch.tensor([[0.0, 0.0, 1.0, 0.0]], dtype=x.dtype)
    faces = [Face(torch.tensor([0.5 if near else 50.0], dtype=x.dtype), slope, True)]
    objective = expected_ahead(Quartic(problem), torch.ones(1, dtype=x.dtype), x, faces, h, channels)  # type: ignore[arg-type]
    strength = torch.tensor([1.5, 2.5, 3.5, 4.5], dtype=x.dtype)[channels]
    far = max(3, len(channels)) if near else len(channels)
    assert objective(action).item() == pytest.approx(far * (strength**4).sum().item() * h**2, rel=1e-9)


class Actuators(ReachAvoidProblem):
    """dx_1 = (u_2 + u_3) dt + 0.2 dW_1 and dx_2 = u_1 dt + (0.3 + u_1^2) dW_2 + (0.4 + u_2/2) dW_3.

    The target is far away.
    """

    horizon = 1.0
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.0, -0.5, -1.0], [0.5, 1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([u[..., 1] + u[..., 2], u[..., 0]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        own, other = 0.3 + u[..., 0].square(), 0.4 + 0.5 * u[..., 1]
        still, zero = torch.full_like(own, 0.2), torch.zeros_like(own)
        return torch.stack([torch.stack([still, zero, zero], -1), torch.stack([zero, own, other], -1)], -2)

    def target_level(self, x: Tensor) -> Tensor:
        return 100.0 - x[..., 0]


@pytest.mark.parametrize("longest", [1.0, 2e-3])
def test_each_coordinate_of_the_control_is_judged_with_the_noise_that_depends_on_it(longest):
    """H is a sum of functions of one coordinate each, so that the best levels are those of the largest generator.

    The weights do not fall where the time to go is less than the length of the step.
    """
    problem = Actuators()
    rule = BestControl(problem, Simulator(problem, 0.01), levels=5, inertia=0.0)
    assert controlled_channels(problem) == [[1], [2], []]
    assert rule.blocks(1) == {(1,): [0], (2,): [1], (): [2]}
    tau, x = points(problem, 50)
    tau = tau.clamp(max=longest)
    solution, levels = Quadratic(problem), torch.linspace(-1, 1, 5).unsqueeze(-1)
    best, weight = rule._improved(solution, tau, x, torch.zeros(50, 3), levels, 0.0)  # type: ignore[arg-type]
    actions = torch.tensor(list(itertools.product(levels.squeeze(-1).tolist(), repeat=3))).unsqueeze(1)
    u = problem.controls.denormalize(actions)
    slope, sigma = solution.gradient(tau, x), problem.diffusion(x, u)
    trace = (sigma * (Quadratic.M @ sigma)).sum((-2, -1))
    generator = ((problem.drift(x, u) * slope).sum(-1) + trace / 2).reshape(5, 5, 5, 50)
    expected = torch.stack(
        [generator.amax((1, 2)).argmax(0), generator.amax((0, 2)).argmax(0), generator.amax((0, 1)).argmax(0)], -1
    )
    assert torch.equal(best, levels.squeeze(-1)[expected])
    ranges = torch.stack([generator.amax(i) - generator.amin(i) for i in range(3)])
    torch.testing.assert_close(weight.mT, ranges[:, 0, 0], rtol=0.02, atol=0.02)


class Channel(ReachAvoidProblem):
    """Brownian motion in the plane, of any strength up to 1, from the avoid set x_1 <= -1 to the target x_1 >= 1."""

    horizon = 1.0
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return u[..., None] * torch.eye(2).to(x)

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        return 3 * (x[..., 0] + 1)


def test_the_value_is_continued_through_faces_as_an_odd_function():
    solution, tau = solution_of(Channel()), torch.full((50,), 0.5)
    y, distance = 2 * torch.rand(50) - 1, torch.rand(50)
    for face, value in ((1.0, 1.0), (-1.0, 0.0)):
        inside, outside = (torch.stack([face * (1 + side * distance), y], -1) for side in (1, -1))
        own, beyond = solution.value(tau, outside), continued_value(solution, tau, inside)
        assert torch.allclose(continued_value(solution, tau, outside), own)
        assert torch.allclose((own + beyond) / 2, torch.tensor(value), atol=1e-5)


def test_the_continuation_does_not_depend_on_the_unit_of_levels():
    """A level of 1e-8 per m, as of a set of the size of a continent, is mirrored like one of 3 per m."""

    class Flat(Channel):
        def avoid_level(self, x: Tensor) -> Tensor:
            return 1e-8 * (x[..., 0] + 1)

    x, tau = torch.stack([-1 - torch.rand(50), torch.rand(50)], -1), torch.full((50,), 0.5)
    own = solution_of(Channel())
    expected = continued_value(own, tau, x)
    found = continued_value(Solution(Flat(), own.actor, own.critic), tau, x)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_the_time_to_a_face_is_that_of_brownian_motion():
    """E min(tau, h) is the integral of P(tau > t) = erf(d / (s sqrt(2 t))) over t up to h."""
    h, distance, spread = torch.tensor(0.3), torch.linspace(1e-3, 3.0, 40, dtype=torch.float64), torch.tensor(1.7)
    t = (torch.arange(200_000, dtype=torch.float64) + 0.5) * h / 200_000
    expected = torch.erf(distance.unsqueeze(-1) / (2 * spread * t).sqrt()).mean(-1)
    found = time_to_exit(distance, torch.zeros(40), spread, h)
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=0)
    assert found[-1] > 0.99999


def test_the_time_to_a_face_ends_with_the_drift_and_has_no_errors_far_away():
    far, none = torch.tensor([1e-6, 0.5, 1e6, torch.inf]), torch.zeros(4)
    one = torch.ones(4)
    whole = pytest.approx([1.0] * 4, abs=1e-5)
    assert time_to_exit(far, none, none, one).tolist() == whole
    assert time_to_exit(far, 2 * one, none, one).tolist() == pytest.approx([5e-7, 0.25, 1.0, 1.0], rel=1e-5)
    assert time_to_exit(far, -one, 1e-20 * one, one).tolist() == whole
    assert time_to_exit(torch.full((4,), torch.nan), one, one, one).tolist() == [1.0] * 4


class Hurried(Channel):
    """Noise of 0.2 to 1 and a drift of up to 0.5 to the target, both of which grow with the control."""

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([u / 2, torch.zeros_like(u)], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.2 + 0.8 * u[..., None]) * torch.eye(2).to(x)


def test_a_step_beside_a_face_is_that_of_paths_that_stop_there():
    """V = 1 - d at the distance d from the target, and the mean over paths that are held there, by simulation."""

    class Linear(Straight):
        problem = Hurried()

        def value(self, tau: Tensor, x: Tensor) -> Tensor:
            return x[..., 0]

    h, steps, paths = 0.01, 400, 20_000
    rng = torch.Generator().manual_seed(0)
    for distance, action in itertools.product((0.003, 0.02, 0.1), (-0.5, 1.0)):
        x, u = torch.tensor([[1 - distance, 0.0]]), Hurried.controls.denormalize(torch.tensor([[action]]))
        faces = absorbing_faces(Hurried(), x)
        objective = expected_ahead(Linear(), torch.ones(1), x, faces, h, [0, 1])  # type: ignore[arg-type]
        found = objective(torch.tensor([[action]]))
        y, alive = torch.full((paths,), 1 - distance), torch.ones(paths, dtype=torch.bool)
        spread = Hurried().diffusion(x, u)[0, 0, 0]
        for _ in range(steps):
            move = u[0, 0] / 2 * h / steps + spread * (h / steps) ** 0.5 * torch.randn(paths, generator=rng)
            # The bridge between two points meets the face with this probability.
            meets = torch.exp(-2 * (1 - y) * (1 - y - move) / (spread**2 * h / steps)).clamp(max=1)
            hit = alive & (torch.rand(paths, generator=rng) < meets)
            y, alive = torch.where(hit, 1.0, torch.where(alive, y + move, y)), alive & ~hit
        error = (y - found).std() / paths**0.5
        assert abs(y.mean() - found) < 4 * error + 1e-5, (distance, action)


class Straight:
    """V = (1 + x_1)/2 between the sets, where noise neither helps nor harms: V is a martingale for any of it."""

    problem = Channel()

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        return ((1 + x[..., 0]) / 2).clamp(0, 1)


def test_noise_beside_a_face_is_not_preferred():
    """Without the continuation into B, a path that crosses its face could return, and noise would seem to help."""
    x = torch.tensor([[-0.999, 0.0], [-0.95, 0.3], [0.0, 0.0], [0.95, 0.3], [0.999, 0.0]])
    faces = absorbing_faces(Channel(), x)
    objective = expected_ahead(Straight(), torch.ones(5), x, faces, 0.05, [0, 1])  # type: ignore[arg-type]
    still, noisy = (objective(torch.full((5, 1), action)) for action in (-1.0, 1.0))
    assert torch.allclose(still, noisy, atol=1e-6)


def test_noise_that_may_reach_the_layer_at_a_face_counts():
    """V = 0.6, and falls to 0 in a layer of 0.1 beside B, which two standard deviations of the step reach.

    The exact mean is that over a Gaussian step which stops at B. With ends at one standard deviation noise would cost
    nothing.
    """

    class Layer(Straight):
        def value(self, tau: Tensor, x: Tensor) -> Tensor:
            return (6 * (1 + x[..., 0])).clamp(0, 0.6)

    x, action = torch.tensor([[-0.75, 0.0]]), torch.ones(1, 1)
    strength = Channel().diffusion(x, Channel().controls.denormalize(action))[0, 0, 0]
    h = float((0.125 / strength) ** 2)
    objective = expected_ahead(Layer(), torch.ones(1), x, absorbing_faces(Channel(), x), h, [0])  # type: ignore[arg-type]
    lost = 0.6 - objective(action).item()
    z = torch.linspace(-8, 8, 160_001, dtype=torch.float64)
    distance = 0.25 + 0.125 * z
    value = (6 * distance).clamp(-0.6, 0.6)
    exact = 0.6 - torch.trapezoid(value * (-z.square() / 2).exp() / math.sqrt(2 * math.pi), z).item()
    assert 0.03 < exact < 0.05
    assert exact / 2 < lost < 2 * exact


def test_a_free_step_goes_half_way_to_the_faces():
    """Two channels of strength 1, which h moves by sqrt(2 h), and levels of any slope; see `free_step`."""
    x = Channel().states.sample(200, torch.Generator().manual_seed(3))
    distance, faces = 1 - x[:, 0].abs(), absorbing_faces(Channel(), x)
    found = free_step(Channel(), x, faces, [0, 1], 1e-3, 0.05)
    torch.testing.assert_close((2 * found).sqrt(), (distance / 2).clamp((2e-3) ** 0.5, 0.1**0.5))
    assert {1e-3, 0.05} <= {round(length, 6) for length in found.tolist()}
    one = free_step(Channel(), x, faces, [0], 1e-3, 10.0)
    torch.testing.assert_close(one, (distance / 2).square().clamp(min=1e-3))
    assert torch.equal(free_step(Channel(), x, faces, [0, 1], 0.05, 0.05), torch.full((200,), 0.05))


def test_a_level_without_a_number_leaves_the_shortest_step():
    class Torn(Channel):
        def avoid_level(self, x: Tensor) -> Tensor:
            return torch.where(x[..., 1] > 0.5, torch.nan, super().avoid_level(x))

    x = torch.tensor([[0.0, 0.6], [0.0, 0.4]])
    found = free_step(Torn(), x, absorbing_faces(Torn(), x), [0, 1], 1e-3, 0.05)
    assert found.tolist() == pytest.approx([1e-3, 0.05])


class Rippled:
    """V = 1/2 - x_1^2/10 with a ripple, in whose troughs V has a positive second derivative along x_1."""

    problem = Channel()

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        return 0.5 - 0.1 * x[..., 0].square() + 4e-5 * torch.cos(100 * x[..., 0])


def test_a_ripple_of_the_value_does_not_decide_on_the_noise():
    """V is concave, so that no noise is best; in the troughs of its ripple one control step shows the opposite."""
    x = torch.stack([torch.tensor([-3.0, -1.0, 1.0, 3.0]) * math.pi / 100, torch.zeros(4)], -1)
    levels, args = torch.linspace(-1, 1, 5).unsqueeze(-1), (Rippled(), torch.full((4,), 0.5), x, torch.zeros(4, 1))
    for ahead, best in ((0.01, -1.0), (0.0, 1.0)):
        rule = BestControl(Channel(), Simulator(Channel(), 1e-4), levels=5, ahead=ahead)
        assert rule._improved(*args, levels, 0.0)[0].tolist() == [[best]] * 4  # type: ignore[arg-type]


@pytest.mark.parametrize("critics", [1, 2])
def test_several_actions_at_once_have_the_values_of_each_of_them_beside_faces(critics):
    """The ends of a step beside a face lie on both of its sides, so that each must have the value of its own place."""
    problem = Gusty()
    one = solution_of(problem)
    solution = Solution(problem, one.actor, stack([Critic(problem) for _ in range(critics)]))
    x = problem.states.sample(2_000, torch.Generator().manual_seed(5))
    level = torch.minimum(problem.avoid_level(x), problem.target_level(x)).abs()
    x = x[problem.interior(x)][level[problem.interior(x)] < 0.05]
    tau, actions = torch.full((len(x),), 0.5), 2 * torch.rand(3, 2, len(x), 2) - 1
    objective = expected_ahead(solution, tau, x, absorbing_faces(problem, x), 0.05, [0, 1])
    found, u, h = objective(actions), problem.controls.denormalize(actions), 0.05
    for i, j in itertools.product(range(3), range(2)):
        drift, sigma, duration = problem.drift(x, u[i, j]), problem.diffusion(x, u[i, j]), torch.full_like(tau, h)
        far = torch.full_like(tau, 2.0)
        for level in (problem.avoid_level, problem.target_level):
            slope = torch.func.grad(lambda y, level=level: level(y).sum())(x)
            spread = torch.einsum("ni,nik->nk", slope, sigma).square().sum(-1)
            share = time_to_exit(level(x), -(slope * drift).sum(-1), spread, torch.full_like(tau, h))
            duration = torch.minimum(duration, h * share)
            if level == problem.avoid_level:
                far[level(x) < 2 * (3 * h * spread).sqrt()] = 3.0
        mean = x + duration.unsqueeze(-1) * drift
        reach = (far * h).sqrt().unsqueeze(-1)
        ends = torch.stack(
            [
                continued_value(solution, tau - h, mean + side * reach * sigma[..., k])
                for k in range(2)
                for side in (1, -1)
            ]
        )
        expected = ends.sum(0) / (2 * far) + (1 - 2 / far) * continued_value(solution, tau - h, mean)
        assert torch.allclose(found[i, j], expected, atol=1e-6)
        assert torch.allclose(objective(actions[i, j]), expected, atol=1e-6)
    with pytest.raises(ArgumentError, match=r"x: expected states \(N, n\) and times to go \(N,\), got \(4, 7, 2\)"):
        solution.value(torch.ones(4, 7), torch.zeros(4, 7, 2))


@pytest.mark.parametrize(("problem", "levels", "cubature"), [(Reach1D(), 2, False), (Steered(True), 5, True)])
def test_what_follows_from_the_problem(problem, levels, cubature):
    rule = BestControl(problem, Simulator(problem, 0.1))
    assert (rule.levels, rule.cubature) == (levels, cubature)
    assert BestControl(problem, Simulator(problem, 0.1), steps=2).levels == 5


@pytest.mark.parametrize("controlled", [False, True])
def test_the_ascent_finds_the_best_of_all_levels(controlled):
    problem, levels = Steered(controlled), torch.linspace(-1, 1, 5)
    solution, (tau, x) = solution_of(problem), points(problem)
    objective = hamiltonian(solution, tau, x, controlled)
    every = torch.stack(
        [objective(torch.tensor(choice).expand(len(x), 3)) for choice in itertools.product(levels.tolist(), repeat=3)]
    )
    action, value = ascend(objective, torch.zeros(len(x), 3), levels)
    # H is a sum over the controls, so that one sweep finds its maximum over the levels.
    assert torch.allclose(value, every.amax(0), atol=1e-6)
    assert torch.allclose(objective(action), value)


def test_all_coordinates_at_once_are_the_best_of_a_sum():
    """f(a) = sum_i (s_i a_i - (a_i - 0.5)^2 [i = 1]): the best of the levels -1, 0, 1 is (1, 0 or 1, -1)."""
    slope = torch.tensor([2.0, 0.3, -1.0])

    def objective(action):
        return action @ slope - (action[..., 1] - 0.5).square()

    start = torch.tensor([[0.2, -0.7, 0.0], [-1.0, 1.0, 1.0]])
    best, stakes = improved(objective, start, torch.tensor([-1.0, 0.0, 1.0]))
    assert torch.equal(best, torch.tensor([[1.0, 1.0, -1.0]]).expand(2, 3))
    assert torch.allclose(stakes[:, [0, 2]], torch.tensor([[4.0, 2.0], [4.0, 2.0]]))


def test_coordinates_that_are_worse_together_are_not_changed_together():
    """f(a) = -(a_1 + a_2 - 1)^2 + a_1/2: from (0, 0) each alone goes to 1, and both together would overshoot."""

    def objective(action):
        return -(action.sum(-1) - 1).square() + 0.5 * action[..., 0]

    best, _ = improved(objective, torch.zeros(1, 2), torch.tensor([-1.0, 0.0, 1.0]))
    assert best.tolist() == [[1.0, 0.0]]


def test_coordinates_together_find_what_none_of_them_finds_alone():
    """f(a) = a_1 a_2 - 0.3 a_1: from (1, 1) each step in one coordinate is for the worse, and (-1, -1) is the best."""

    def objective(action):
        return action[..., 0] * action[..., 1] - 0.3 * action[..., 0]

    start, marks = torch.ones(1, 2), torch.tensor([-1.0, 0.0, 1.0])
    pairs = torch.cartesian_prod(marks, marks)
    assert improved(objective, start, marks)[0].tolist() == ascend(objective, start, marks)[0].tolist() == [[1.0, 1.0]]
    best, stakes = improved(objective, start, pairs)
    assert best.tolist() == ascend(objective, start, pairs)[0].tolist() == [[-1.0, -1.0]]
    assert stakes.tolist() == [[pytest.approx(1.3 + 1.3)]]
    # The distance of a pair is the larger one of both, 2: the gain 0.6 has to exceed 2 * 0.1 * 2.6, or 2 * 0.2 * 2.6.
    assert improved(objective, start, pairs, 0.1)[0].tolist() == [[-1.0, -1.0]]
    assert improved(objective, start, pairs, 0.2)[0].tolist() == [[1.0, 1.0]]


def test_groups_of_coordinates_are_improved_at_once():
    """f is a sum over the pairs (a_1, a_2) and (a_3, a_4), of which the first has its best at (-1, -1)."""

    def objective(action):
        return action[..., 0] * action[..., 1] - 0.3 * action[..., 0] + action[..., 2] - action[..., 3]

    marks = torch.tensor([-1.0, 0.0, 1.0])
    best, stakes = improved(objective, torch.ones(5, 4), torch.cartesian_prod(marks, marks))
    assert torch.equal(best, torch.tensor([[-1.0, -1.0, 1.0, -1.0]]).expand(5, 4))
    assert torch.allclose(stakes, torch.tensor([[2.6, 4.0]]))


def test_coordinates_that_are_not_tried_stand_still():
    """f is the sum of the coordinates: those that are tried go to 1, each with a range of 2."""
    start = torch.tensor([[0.5, -0.3, 0.1], [0.0, 0.0, -1.0]])
    best, stakes = improved(lambda a: a.sum(-1), start, torch.tensor([-1.0, 1.0]), tried=[2, 0])
    assert torch.equal(best, torch.stack([torch.ones(2), start[:, 1], torch.ones(2)], -1))
    assert torch.allclose(stakes, torch.full((2, 2), 2.0))


@pytest.mark.parametrize(("tilt", "inertia", "expected"), [(0.05, 0.0, 1.0), (0.05, 0.1, -1.0), (0.5, 0.1, 1.0)])
def test_inertia_decides_between_levels_that_are_nearly_as_good(tilt, inertia, expected):
    """f(a) = |a| + tilt a from -0.8: the penalty of the bound 1 exceeds that of -1 by 0.1 * 1.6 of the range."""
    start, levels = torch.tensor([[-0.8]]), torch.tensor([-1.0, 0.0, 1.0])
    best, stakes = improved(lambda a: (a.abs() + tilt * a).squeeze(-1), start, levels, inertia)
    assert best.item() == expected
    assert stakes.item() == pytest.approx(1 + tilt)


@pytest.mark.parametrize(("disaster", "expected"), [(-1.0, 1.0), (0.0, -0.5)])
def test_a_level_that_is_much_worse_holds_back_an_action_that_would_pass_it_alone(disaster, expected):
    """f(a) = a from -0.5, less 100 at one level, which lies behind the action or between it and the best level."""

    def objective(action):
        level = action.squeeze(-1)
        return level - 100 * (level == disaster)

    best, stakes = improved(objective, torch.tensor([[-0.5]]), torch.tensor([-1.0, 0.0, 1.0]), 0.1)
    assert best.item() == expected
    assert stakes.item() == pytest.approx(1 - (disaster - 100))


def test_a_combination_is_held_back_by_those_in_the_box_between_alone():
    """f(a) = a_1 + a_2 from (-1, -1), less 100 at (-1, 1), which is a corner of the box up to (1, 1), or at (-1, 2)."""
    levels = torch.cartesian_prod(torch.tensor([-1.0, 1.0]), torch.tensor([-1.0, 1.0, 2.0]))
    for disaster, expected in (((-1.0, 1.0), [1.0, -1.0]), ((-1.0, 2.0), [1.0, 1.0])):

        def objective(action, disaster=disaster):
            return action.sum(-1) - 100 * (action == torch.tensor(disaster)).all(-1)

        assert improved(objective, -torch.ones(1, 2), levels, 0.1)[0].tolist() == [expected]


def test_inertia_does_not_matter_where_the_objective_is_affine():
    problem = Steered()
    solution, (tau, x) = solution_of(problem), points(problem)
    objective, levels = hamiltonian(solution, tau, x, False), torch.tensor([-1.0, 1.0])
    start = 2 * torch.rand(len(x), 3, generator=torch.Generator().manual_seed(3)) - 1
    assert torch.equal(improved(objective, start, levels, 0.1)[0], improved(objective, start, levels)[0])


@pytest.mark.parametrize("inertia", [0.0, 0.1])
def test_every_fourth_level_leads_to_the_best_of_all_where_there_is_one_maximum(inertia):
    """f(a) = -(a_1 - c)^2 + a_1 a_2 / 4 - 2 |a_2 - d|, which is concave in each coordinate."""
    rng = torch.Generator().manual_seed(4)
    peak, start = (2 * torch.rand(300, 2, generator=rng, dtype=torch.float64) - 1 for _ in range(2))
    calls = []

    def objective(action):
        calls.append(action.shape[:-1].numel())
        first, second = action.unbind(-1)
        return -(first - peak[:, 0]).square() + first * second / 4 - 2 * (second - peak[:, 1]).abs()

    levels = torch.linspace(-1, 1, 33, dtype=torch.float64)
    best, stakes = improved(objective, start, levels, inertia, stride=4)
    few = sum(calls)
    calls.clear()
    every, range_of_all = improved(objective, start, levels, inertia)
    assert few == 300 * (1 + 2 * (9 + 6) + 1)
    assert sum(calls) == 300 * (1 + 2 * 33 + 1)
    assert torch.allclose(best, every)
    assert (stakes <= range_of_all + 1e-12).all()
    assert (stakes >= 0.9 * range_of_all).all()


@pytest.mark.parametrize("controlled", [False, True])
def test_an_improvement_is_none_for_the_worse(controlled):
    problem = Steered(controlled)
    solution, (tau, x) = solution_of(problem), points(problem)
    objective = hamiltonian(solution, tau, x, controlled)
    start = 2 * torch.rand(len(x), 3, generator=torch.Generator().manual_seed(2)) - 1
    best, stakes = improved(objective, start, torch.linspace(-1, 1, 5))
    assert (objective(best) >= objective(start) - 1e-6).all()
    assert (stakes >= 0).all()
    if not controlled:  # H is affine in u, so that a vertex is the maximum
        vertices = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=3)))
        largest = torch.stack([objective(vertex.expand(len(x), 3)) for vertex in vertices]).amax(0)
        assert torch.allclose(objective(best), largest, atol=1e-6)


def test_more_controls_take_fewer_points():
    problem = Steered()
    solution, (tau, x) = solution_of(problem), points(problem)
    batch = TensorDict({"tau": tau.unsqueeze(-1), "state": x}, [len(x)])
    few, all_of_them = (BestControl(problem, Simulator(problem, 0.1), budget=n, hold=0) for n in (3 * 10, 8_192))
    assert torch.equal(few(solution, batch, batch), all_of_them(solution, batch[:10], batch[:10]))


def test_where_candidates_are_simulated_the_points_are_fewer():
    """With three controls and five levels, each point needs 15 paths of two steps.

    Or it needs five cubatures, whose four ends count as a step, for the only control on which the noise depends, and
    one unit for each of the others. With seven levels, the choices of an actor for example, it needs seven cubatures.
    """
    problem = Steered(controlled=True)
    simulator = Simulator(problem, 0.1)
    five, seven = (torch.linspace(-1, 1, count).unsqueeze(-1) for count in (5, 7))
    assert BestControl(problem, simulator, budget=10 * 7 + 6).most_points(five) == 10
    assert BestControl(problem, simulator, budget=10 * 9 + 8).most_points(seven) == 10
    assert BestControl(problem, simulator, steps=2, budget=10 * 30 + 29).most_points(five) == 10


@pytest.mark.parametrize("controlled", [False, True])
def test_a_short_look_ahead_is_the_hamiltonian(controlled):
    """(V ahead of u - V ahead of 0)/dt tends to H(u) - H(0), with an error of the order of dt."""
    problem = Steered(controlled)
    solution, (tau, x), dt = solution_of(problem), points(problem), 1e-4
    ahead = value_ahead(solution, Simulator(problem, dt), tau, x, 1)
    slope = hamiltonian(solution, tau, x, controlled)
    actions = 2 * torch.rand(4, len(x), 3, generator=torch.Generator().manual_seed(3)) - 1
    still = torch.zeros(len(x), 3)
    inside = problem.interior(x) & (solution.raw_value(tau, x) > 0) & (solution.raw_value(tau, x) < 1)
    expected, found = slope(actions) - slope(still), (ahead(actions) - ahead(still)) / dt
    torch.testing.assert_close(found[:, inside], expected[:, inside], rtol=0.01, atol=0.01)


def test_the_policy_acts_after_the_first_step_of_a_look_ahead():
    """Two steps ahead with a are one step with a, and V one step ahead of there with the policy."""
    problem = Steered()
    solution, (tau, x), simulator = solution_of(problem), points(problem), Simulator(problem, 0.05)
    action = torch.full((len(x), 3), 0.3)
    after = simulator.flow(x, problem.controls.denormalize(action), torch.full((len(x),), 0.05))
    policy = problem.controls.normalize(solution.policy(tau - 0.05, after))
    alive = problem.interior(x) & problem.interior(after) & (tau > 0.1)
    expected = value_ahead(solution, simulator, tau - 0.05, after, 1)(policy)
    found = value_ahead(solution, simulator, tau, x, 2)(action)
    torch.testing.assert_close(found[alive], expected[alive])


def test_the_rule_turns_a_saturated_actor_round_where_the_gradient_of_the_hamiltonian_does_not():
    problem = Reach1D()  # the best control is 1 everywhere
    tau, x = points(problem, 256)
    replay = TensorDict({"tau": tau.unsqueeze(-1), "state": x}, batch_size=[256])
    pushed = {}
    for rule in (BestControl(problem, Simulator(problem, 0.1), hold=0), Hamiltonian(problem)):
        solution = Solution(problem, Actor(problem), stack([Rising(problem)]))
        last = solution.actor.layers[-2]
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.constant_(last.bias, -12.0)
        rule(solution, replay, replay).backward()
        pushed[type(rule)] = last.bias.grad.item()
    # tanh'(-12) is 1.5e-10, and the rule's own gradient is T w (a - pi) = 2 * 2 * 2 for a slope of 1.
    assert pushed[BestControl] == pytest.approx(8.0, rel=1e-3)
    assert abs(pushed[Hamiltonian]) < 1e-8


def test_the_rule_raises_the_score_of_the_best_choice():
    """For the slope 1 the range of the Hamiltonian is 2 at every state, and the gradient 2 T (softmax - one-hot)."""
    problem = Reach1D()
    tau, x = points(problem, 256)
    replay = TensorDict({"tau": tau.unsqueeze(-1), "state": x}, batch_size=[256])
    solution = Solution(problem, Actor(problem, choices=3), stack([Rising(problem)]))
    last = solution.actor.layers[-2]
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    (-BestControl(problem, Simulator(problem, 0.1))(solution, replay, replay)).backward()
    expected = 2 * problem.horizon * torch.tensor([1 / 3, 1 / 3, -2 / 3])
    assert torch.allclose(last.bias.grad, expected, rtol=1e-4)


@pytest.mark.parametrize(("inertia", "index"), [(None, 3), (0.1, 32)])
def test_an_actor_with_choices_turns_from_pi_to_a_heading_just_above_minus_pi(inertia, index):
    """The best heading, -2.55, has the index 3 of 33; that of pi, which the actor has, is worse by 8 % of the range."""
    problem = Heading()
    tau, x = points(problem, 16)
    replay = TensorDict({"tau": tau.unsqueeze(-1), "state": x}, batch_size=[16])
    solution = Solution(problem, Actor(problem, choices=33), stack([Slanted(problem)]))
    last = solution.actor.layers[-2]
    torch.nn.init.zeros_(last.weight)
    last.bias.data = torch.nn.functional.one_hot(torch.tensor(32), 99).float()
    BestControl(problem, Simulator(problem, 0.1), inertia=inertia)(solution, replay, replay).backward()
    assert last.bias.grad[:33].argmax() == index


@pytest.mark.parametrize(
    ("problem", "levels"),
    [
        *((Steered(), 2), (PlanarQuadrotor(), 2)),  # the Hamiltonian is affine in u
        *((Steered(controlled=True), 5), (Shaken(), 5), (VehicleDrift(), 5), (Bicycle(), 5), (Heading(), 33)),
    ],
    ids=["affine", "six states", "noise", "noise alone", "tyres", "bicycle", "heading"],
)
def test_levels_of_a_control(problem, levels):
    assert control_levels(problem) == levels
    assert BestControl(problem, Simulator(problem)).levels == levels
    assert BestControl(problem, Simulator(problem), steps=1).levels == max(5, levels)


@pytest.mark.parametrize(
    ("problem", "joint", "coarse"),
    [
        *((Steered(), False, False), (VehicleDrift(), False, False), (VehicleDrift3(), False, True)),
        *((Bicycle(), True, False), (TwoHarbours(), False, True), (Loiter(), False, True)),
        *((Sprint(), False, True), (Gusty(), False, False), (Investor(), False, True)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_how_the_best_control_changes(problem, joint, coarse):
    """Forwards to the left and backwards to the right are vertices, for which five levels suffice; headings are not.

    The best speed of a sprint and the best share at risk lie between their bounds. Noise that grows with |u| makes
    either bound or the middle the best.
    """
    for seed in range(3):
        found = switching(problem, seed)
        assert (found.joint > JOINT) == joint
        assert (found.coarseness > COARSE) == coarse


@pytest.mark.parametrize(
    ("problem", "choices"),
    [(Steered(), None), (Bicycle(), 5), (Gusty(), 5), (Sprint(), 33), (Investor(), 33)],
    ids=lambda value: type(value).__name__,
)
def test_where_an_actor_chooses(problem, choices):
    """An actor chooses where the best control jumps in other ways than from bound to bound."""
    assert actor_choices(problem) == choices


@pytest.mark.parametrize(
    ("controlled", "typed", "choices"),
    [
        (False, [], None),
        (True, [], 5),
        (True, ["actor.choices=3"], 3),
        (True, ["actor.choices=null"], None),
        (True, ["pirl.actor_rule._target_=pirl_rl.actor_rules.Hamiltonian"], None),
        (True, ["+pirl.actor_rule.steps=2"], None),
        (True, ["method=td3"], None),
        (True, ["stages=[{share:1},{share:1,actor_rule:{_target_:pirl_rl.actor_rules.BestControl}}]"], 5),
        (True, ["stages=[{share:1},{share:1,actor_rule:{_target_:pirl_rl.actor_rules.Hamiltonian}}]"], None),
    ],
)
def test_the_actor_chooses_where_the_noise_depends_on_the_control(controlled, typed, choices):
    config = compose("train", ["+experiment=reach1d", *typed])
    choose_actor(config, Steered(controlled))
    assert config.actor.choices == choices


@pytest.mark.parametrize(
    ("controlled", "typed", "logs"),
    [
        (False, [], False),
        (True, [], True),
        (True, ["actor.log_levels=false"], False),
        (True, ["actor.levels=false"], False),
        (False, ["actor.log_levels=true"], True),
    ],
)
def test_the_actor_sees_logarithms_of_levels_where_the_noise_depends_on_the_control(controlled, typed, logs):
    config = compose("train", ["+experiment=reach1d", *typed])
    choose_actor(config, Steered(controlled))
    assert config.actor.log_levels is logs
    layers = build(config.actor, "actor", problem=Steered(controlled)).layers
    assert any(isinstance(layer, LogLevels) for layer in layers) == logs


@pytest.mark.parametrize(
    ("problem", "typed", "choices", "together"),
    [
        (Heading(), [], 33, 1),
        (Bicycle(), [], 5, 2),
        (Bicycle(), ["actor.together=1"], 5, 1),
        (Bicycle(), ["actor.choices=12"], 12, 1),  # 144 combinations
        (Steered(), [], None, 1),
        (Steered(controlled=True), [], 5, 1),
    ],
)
def test_the_actor_chooses_whole_controls_where_their_combinations_are_few(problem, typed, choices, together):
    config = compose("train", ["+experiment=reach1d", *typed])
    choose_actor(config, problem)
    assert (config.actor.choices, config.actor.together) == (choices, together)


@pytest.mark.parametrize(
    ("problem", "typed", "window"),
    [
        (Investor(), [], 0.5),
        (Investor(), ["actor.window=0.2"], 0.2),
        (Investor(), ["actor.choices=9"], 0.0),
        (Investor(), ["+pirl.actor_rule.steps=2"], 0.0),  # a tanh output
        (Sprint(), [], 0.0),  # the noise does not depend on the control
        (Gusty(), [], 0.0),  # five levels
        (Bicycle(), [], 0.0),
        (Steered(), [], 0.0),
    ],
)
def test_the_actor_takes_the_mean_of_near_levels_where_the_best_noise_lies_between_the_bounds(problem, typed, window):
    config = compose("train", ["+experiment=reach1d", *typed])
    choose_actor(config, problem)
    assert config.actor.window == window
    assert build(config.actor, "actor", problem=problem)(torch.ones(1, 1), problem.states.sample(1)).isfinite().all()


def test_a_look_ahead_tries_whole_controls_where_the_best_one_jumps():
    assert candidate_controls(Bicycle()).shape == (25, 2)
    assert candidate_controls(Bicycle(), 13).shape == (13, 1)  # 169 combinations
    assert candidate_controls(Steered()).tolist() == [[-1.0], [-0.5], [0.0], [0.5], [1.0]]


def test_a_rule_that_needs_the_gradient_of_the_policy_refuses_choices():
    rule = "pirl.actor_rule._target_=pirl_rl.actor_rules.Hamiltonian"
    config = compose("train", ["+experiment=reach1d", "+debug=default", "actor.choices=5", rule])
    with pytest.raises(ConfigError, match=r"loss.actor_rule: expected BestControl with actor.choices=5.* Hamiltonian"):
        make_trainer(config)


class Rising(Critic):
    """V = x_1, for which the best control is known."""

    def forward(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        return state[..., :1].unsqueeze(0)


class Slanted(Critic):
    """V = x_1 cos a + x_2 sin a, for which the best heading is a = -13 pi/16."""

    def forward(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        heading = torch.tensor(-13 / 16 * math.pi)
        return (state * torch.stack([heading.cos(), heading.sin()])).sum(-1, keepdim=True).unsqueeze(0)


def test_masked_points_do_not_count():
    problem = Steered()
    solution, (tau, x) = solution_of(problem), points(problem)
    every = TensorDict({"tau": tau.unsqueeze(-1), "state": x, "mask": torch.arange(64) < 32}, batch_size=[64])
    rule = BestControl(problem, Simulator(problem, 0.1))
    assert torch.allclose(rule(solution, every, every), rule(solution, every[:32], every[:32].exclude("mask")))


def test_what_the_rule_refuses():
    with pytest.raises(ArgumentError, match=r"ahead >= 0 and hold >= 0, got 0, 1, 8192, None, 0\.01 and 0\.02"):
        BestControl(Reach1D(), Simulator(Reach1D(), 0.1), levels=1)
    with pytest.raises(ArgumentError, match=r"budget >= 1, inertia >= 0, .* got 0, 2, 0, None, 0\.01 and 0\.02"):
        BestControl(Reach1D(), Simulator(Reach1D(), 0.1), budget=0)
    with pytest.raises(ArgumentError, match=r"ahead >= 0 and hold >= 0, got 0, 2, 8192, None, -1 and 0\.02"):
        BestControl(Reach1D(), Simulator(Reach1D(), 0.1), ahead=-1)
    with pytest.raises(ArgumentError, match=r"inertia >= 0, ahead >= 0 .* got 0, 2, 8192, -0\.1, 0\.01 and 0\.02"):
        BestControl(Reach1D(), Simulator(Reach1D(), 0.1), inertia=-0.1)
    with pytest.raises(ArgumentError, match=r"expected critic\.action_input=false"):
        BestControl(Reach1D(), Simulator(Reach1D(), 0.1)).check(Critic(Reach1D(), action_input=True))
