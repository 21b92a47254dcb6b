"""What a control is worth that is held for a while, and the rule that compares both bounds by it."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.action_values import hamiltonian
from pirl_rl.actor_rules import BestControl
from pirl_rl.ascent import best_bounds, improved
from pirl_rl.errors import ArgumentError
from pirl_rl.holding import held_value
from pirl_rl.networks import Actor
from pirl_rl.simulator import Simulator


class Turn(ReachAvoidProblem):
    """dX = v dt + dW / 10 with |v| <= 2 on a ring of length 4; the wall |x - 3/2| <= 0.1 is never to be entered."""

    horizon = 5.0
    states, controls = Box([-2.0], [2.0], periodic=[0]), Box([-2.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.1 * torch.ones_like(x).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        return 1 - x[..., 0] * 0

    def avoid_level(self, x: Tensor) -> Tensor:
        return (x[..., 0] - 1.5).abs() - 0.1


class Known:
    """V = 1/2 + bend(x) + 0.02 tau in place of learned networks, with the values of the sets."""

    def __init__(self, problem: ReachAvoidProblem, bend):
        self.problem, self.bend, self.actor = problem, bend, Actor(problem)

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        assert tau.ndim == 1
        assert x.ndim == 2
        return (0.5 + self.bend(x[..., 0]) + 0.02 * tau).masked_fill(self.problem.failed(x), 0.0)

    def gradient(self, tau: Tensor, x: Tensor) -> Tensor:
        return torch.func.grad(lambda y: self.bend(y[..., 0]).sum())(x)


def valley(x: Tensor) -> Tensor:
    """A valley that is rounded off at x = 0.05, whose right side is higher away from its bottom."""
    return 0.1 * ((x - 0.05).square() + 0.01).sqrt() + 0.05 * x


X = torch.linspace(-1, 1, 81, dtype=torch.float64).unsqueeze(-1)
TAU = torch.full((81,), 1.0, dtype=torch.float64)


def test_on_a_ridge_the_value_of_a_held_control_is_the_hamiltonian():
    solution = Known(Turn(), lambda x: -0.1 * (x - 0.2).square())
    actions = torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None, None].expand(-1, 81, 1)
    expected = hamiltonian(solution, TAU, X, False)(actions)
    torch.testing.assert_close(held_value(solution, TAU, X, 0.1)(actions), expected)


def test_in_a_valley_it_is_the_change_of_the_value():
    """With |v| = 2 a path comes 0.2 far in 0.1 s. V falls by 0.02 in each second besides, for all controls alike."""
    solution = Known(Turn(), valley)
    for bound in (-1.0, 1.0):
        found = held_value(solution, TAU, X, 0.1)(torch.full_like(X, bound))
        torch.testing.assert_close(found, (valley(X + 0.2 * bound) - valley(X)).squeeze(-1) / 0.1)


def test_a_held_control_finds_the_better_way_out_of_a_valley():
    """V at x = -0.15 falls towards the bottom at 0.0, and is higher at 0.25 than at -0.55."""
    solution = Known(Turn(), valley)
    (x,), (tau,) = (torch.full((1, 1, 1), -0.15), torch.ones(1, 1))
    still = torch.zeros(1, 1)
    locally, _ = improved(hamiltonian(solution, tau, x, False), still, torch.tensor([-1.0, 1.0]))
    held, weight = best_bounds(held_value(solution, tau, x, 0.2), still)
    assert (locally.item(), held.item()) == (-1.0, 1.0)
    gain = (valley(x + 0.4) - valley(x - 0.4)).item() / 0.2
    assert weight.item() == pytest.approx(gain, rel=1e-4)


def test_a_held_control_ends_at_the_horizon():
    """With 0.05 s to go the control is held for 0.05 s."""
    solution, tau = Known(Turn(), valley), torch.full_like(TAU, 0.05)
    found = held_value(solution, tau, X, 0.1)(torch.ones_like(X))
    torch.testing.assert_close(found, (valley(X + 0.1) - valley(X)).squeeze(-1) / 0.05)


def test_a_held_control_stops_in_a_set():
    """Half way from x = 1.3 the path is in the wall, where V = 0; it would be past it at 1.7 in the end."""
    solution = Known(Turn(), lambda x: 0.1 * x.square())
    x, tau = torch.tensor([[1.3]]), torch.ones(1)
    tangent = 2 * 0.2 * 1.3
    assert held_value(solution, tau, x, 0.2)(torch.ones(1, 1)).item() == pytest.approx(tangent)  # above -V/h
    back = held_value(solution, tau, x, 0.2)(-torch.ones(1, 1)).item()
    assert back == pytest.approx(0.1 * (0.9**2 - 1.3**2) / 0.2, rel=1e-4)


def test_a_held_control_does_not_pass_a_thin_wall():
    """From x = 1.3 the first half of the path ends at 1.7, past the wall, and has its middle in it."""
    solution = Known(Turn(), lambda x: 0.01 * x.square())
    x, tau = torch.tensor([[1.3]]), torch.ones(1)
    through = held_value(solution, tau, x, 0.4)(torch.ones(1, 1)).item()
    assert through == pytest.approx(2 * 0.02 * 1.3)  # the tangent, which is above -V/h
    assert through < 0.01 * (2.1**2 - 1.3**2) / 0.4  # what the way through the wall would be worth


def test_a_control_is_held_for_eight_control_steps_at_most():
    problem = Turn()
    assert BestControl(problem, Simulator(problem, 0.0125)).held == pytest.approx(0.1)
    assert BestControl(problem, Simulator(problem, 0.003125)).held == pytest.approx(0.025)
    assert BestControl(problem, Simulator(problem, 0.003125), steps=1).held == 0


class Swing(ReachAvoidProblem):
    """X1' = 7 X2 and X2' = -7 X1 + u with noise, an oscillator whose matrix has eigenvalues of modulus 7."""

    objective = "invariance"
    horizon = 100.0
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([7 * x[..., 1], u[..., 0] - 7 * x[..., 0]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.full_like(x, 0.1).unsqueeze(-1)

    def avoid_level(self, x: Tensor) -> Tensor:
        return 0.9 - x.abs().amax(-1)


@pytest.mark.parametrize(
    ("dt", "held"),
    [
        pytest.param(0.25, 0, id="shorter than a control step"),
        pytest.param(0.05, 0.5 / 7, id="half the time of a turn"),
        pytest.param(0.005, 0.04, id="eight control steps"),
    ],
)
def test_a_control_is_held_for_less_than_the_drift_takes_to_turn(dt, held):
    """The swing turns by 1 in 1/7 s, and a fiftieth of the horizon are 2 s."""
    problem = Swing()
    assert BestControl(problem, Simulator(problem, dt)).held == pytest.approx(held, rel=1e-6)


def test_a_held_control_of_an_oscillator_counts_with_the_right_sign():
    """At rest u = 1 pushes X2 up at once, but leads to X2 < 0 after more than half a period of 0.9 s.

    V grows with X2 and bends upwards, so that what the control is worth after it was held takes the place of the
    tangent.
    """
    problem = Swing()
    solution = Known(problem, lambda x: x)
    solution.value = lambda tau, x: 0.2 * (4 * x[..., 1]).exp()
    solution.gradient = lambda tau, x: torch.func.grad(lambda y: solution.value(tau, y).sum())(x)
    x, tau = torch.zeros(1, 2), torch.ones(1)
    for length, best in ((BestControl(problem, Simulator(problem, 0.05)).held, 1.0), (0.6, -1.0)):
        assert best_bounds(held_value(solution, tau, x, length), torch.zeros(1, 1))[0].item() == best


def test_a_held_control_follows_a_period():
    """From x = -1.9 a path of -0.4 ends at 1.7, where a valley with its bottom at 1.7 is lowest."""
    solution = Known(Turn(), lambda x: 0.1 * (x - 1.7).square())
    x, tau = torch.tensor([[-1.9]]), torch.ones(1)
    tangent = -2 * 0.2 * (-1.9 - 1.7)
    ahead = -0.1 * (1.9 + 1.7) ** 2 / 0.2
    assert held_value(solution, tau, x, 0.2)(-torch.ones(1, 1)).item() == pytest.approx(max(tangent, ahead), rel=1e-4)


def test_the_drift_of_a_turn_is_followed_by_the_midpoint_rule():
    """A point on a circle around 0 goes on along it, up to the third power of the angle of a step."""

    class Circle(Turn):
        states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-2.0], [2.0])

        def drift(self, x, u):
            return u * torch.stack([x[..., 1], -x[..., 0]], -1)

        def diffusion(self, x, u):
            return 0.1 * torch.eye(2).expand(*x.shape, 2)

        def avoid_level(self, x):
            return 1 + 0 * x[..., 0]

    solution = Known(Circle(), lambda x: 0.1 * x.square())
    x, tau = torch.tensor([[0.0, 1.0]]), torch.ones(1)
    found = held_value(solution, tau, x, 0.1)(torch.ones(1, 1)).item()
    assert found == pytest.approx(0.1 * math.sin(0.2) ** 2 / 0.1, rel=0.01)


def test_the_bounds_that_are_taken_maximise_an_affine_objective():
    slopes = torch.tensor([[0.3, -0.2, 0.0], [math.nan, 1.0, -1.0]])
    action = torch.tensor([[0.5, 0.5, 0.5], [0.0, 0.0, 0.0]])
    best, weight = best_bounds(lambda a: (a * slopes).nansum(-1), action)
    assert best[0, :2].tolist() == [1.0, -1.0]
    assert best[1, 1:].tolist() == [1.0, -1.0]
    torch.testing.assert_close(weight, 2 * slopes.abs().nan_to_num(0.0))


def test_the_rule_turns_the_actor_to_the_better_way():
    """The gradient of its loss in the output before the tanh leads to +1, with the weight of the held control."""
    problem = Turn()
    solution = Known(problem, valley)
    last = solution.actor.layers[-2]
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.zeros_(last.bias)
    batch = TensorDict({"tau": torch.ones(64, 1), "state": torch.full((64, 1), -0.15)}, [64])
    pushed = {}
    for hold in (0.0, 0.04):
        solution.actor.zero_grad()
        BestControl(problem, Simulator(problem, 0.05), hold=hold)(solution, batch, batch).backward()
        pushed[hold] = last.bias.grad.item()
    gain = (valley(torch.tensor(0.25)) - valley(torch.tensor(-0.55))).item() / 0.2
    assert pushed[0.0] < 0
    assert pushed[0.04] == pytest.approx(problem.horizon * gain, rel=1e-4)


def test_points_with_held_controls_are_fewer():
    problem = Turn()
    levels = torch.tensor([[-1.0], [1.0]])
    rule = BestControl(problem, Simulator(problem, 0.05), budget=10 * 16 + 15)
    assert rule.most_held() == 10
    assert rule.most_points(levels) == 175


def test_a_time_below_zero_is_refused():
    with pytest.raises(ArgumentError, match=r"hold >= 0, got 0, 2, 8192, None, 0\.01 and -1"):
        BestControl(Turn(), Simulator(Turn(), 0.05), hold=-1)
