"""Payoffs: values, smoothness and the set A_eps that absorbs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pirl_rl.payoffs import Indicator, LipschitzPayoff, SmoothPayoff
from pirl_rl.problems import Reach1D

EPSILON = 0.4
PAYOFFS = [Indicator(), LipschitzPayoff(EPSILON), SmoothPayoff(EPSILON)]


def kind(payoff) -> str:
    return type(payoff).__name__


@pytest.mark.parametrize("payoff", PAYOFFS, ids=kind)
def test_one_on_a_eps_zero_outside_a_and_falling_between(payoff):
    level = torch.linspace(-1, 1, 2001, dtype=torch.float64)
    value = payoff(level)
    assert (value[level <= -payoff.epsilon] == 1).all()
    assert (value[level > 0] == 0).all()
    assert (value.diff() <= 1e-15).all()
    single = payoff(level.float())
    assert ((single >= 0) & (single <= 1)).all()


@pytest.mark.parametrize("payoff", PAYOFFS[1:], ids=kind)
def test_symmetric_about_half(payoff):
    distance = torch.linspace(0, EPSILON / 2, 101, dtype=torch.float64)
    torch.testing.assert_close(
        payoff(-EPSILON / 2 - distance) + payoff(-EPSILON / 2 + distance), torch.ones_like(distance)
    )


def test_lipschitz_payoff_is_the_papers():
    level = torch.tensor([-0.5, -0.4, -0.3, -0.1, 0.0, 0.1], dtype=torch.float64)
    expected = torch.tensor([1.0, 1.0, 0.75, 0.25, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(LipschitzPayoff(EPSILON)(level), expected)


def test_smooth_payoff_is_the_septic_smoothstep():
    assert SmoothPayoff(1.0)(torch.tensor(-0.25, dtype=torch.float64)).item() == pytest.approx(
        0.070556640625, abs=1e-15
    )


@pytest.mark.parametrize("joint", [0.0, -EPSILON])
def test_smooth_payoff_has_three_derivatives_and_no_fourth_at_its_joints(joint):
    """Differences on a stencil across the joint fall linearly for orders up to three, not at all for order four."""

    def derivative(order: int, h: float) -> float:
        stencil = joint + h * (torch.arange(order + 1, dtype=torch.float64) - order / 2)
        return SmoothPayoff(EPSILON)(stencil).diff(n=order).item() / h**order

    scale = 840 / EPSILON**4  # the fourth derivative inside, up to sign
    for order in (1, 2, 3):
        assert abs(derivative(order, 1e-3)) < scale * 1e-3
        assert abs(derivative(order, 5e-4)) < 0.6 * abs(derivative(order, 1e-3)) + 1e-4
    assert abs(derivative(4, 1e-3)) > 0.1 * scale


@pytest.mark.parametrize("epsilon", [0.0, -1.0, float("nan")])
@pytest.mark.parametrize("smoothed", [LipschitzPayoff, SmoothPayoff])
def test_a_width_that_is_not_positive_is_refused(smoothed, epsilon):
    with pytest.raises(ValueError, match=f"{smoothed.__name__}: epsilon must be positive"):
        smoothed(epsilon)


def test_the_indicator_has_no_width():
    with pytest.raises(ValueError, match=r"got 0\.1"):
        Indicator(0.1)


class Scaled(Reach1D):
    """The same target with a level that is no distance: a payoff must not see the difference."""

    def target_level(self, x: Tensor) -> Tensor:
        return 7 * (2 - x[..., 0]) + (2 - x[..., 0]) ** 3


@pytest.mark.parametrize("payoff", PAYOFFS, ids=kind)
def test_a_problem_absorbs_on_a_eps_and_pays_l_eps(payoff):
    problem = Reach1D(payoff=payoff)
    x = torch.linspace(1, 3, 401, dtype=torch.float64).unsqueeze(-1)
    distance = x[:, 0] - 2
    assert torch.equal(problem.reached(x), distance >= payoff.epsilon)
    assert torch.equal(problem.interior(x), ~problem.reached(x))
    torch.testing.assert_close(problem.boundary_value(x), payoff(-distance))


@pytest.mark.parametrize("payoff", PAYOFFS[1:], ids=kind)
def test_the_level_is_normalised(payoff):
    """To first order: 7 d + d^3 over its slope is d + O(d^3)."""
    x = torch.linspace(1.5, 2.7, 401, dtype=torch.float64).unsqueeze(-1)
    plain, scaled = (problem(payoff=payoff).boundary_value(x) for problem in (Reach1D, Scaled))
    assert (plain - scaled).abs().max() < 2 * 0.4**3 / 7 * 2.2 / EPSILON
