"""Boxes and the algebra of levels, as properties of random points."""

from __future__ import annotations

import math

import pytest
import torch

from pirl_rl.errors import ArgumentError
from pirl_rl.sets import Box, band, complement, difference, intersection, union

BOX = Box([-1.0, 2.0, 0.0], [1.0, 6.0, 0.5])
ROUND = Box([-2.0, -math.pi], [2.0, math.pi], periodic=[1])
ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-13}
"""Some units in the last place of coordinates up to 100."""


def levels(count: int = 3):
    rng = torch.Generator().manual_seed(0)
    return torch.randn(count, 500, generator=rng).unbind(0)


def uniform(size: float, count: int, dtype=torch.float64):
    return size * (2 * torch.rand(count, 2, generator=torch.Generator().manual_seed(0), dtype=dtype) - 1)


def test_algebra_is_that_of_membership():
    a, b, c = levels()
    inside = [level <= 0 for level in (a, b, c)]
    assert torch.equal(union(a, b, c) <= 0, inside[0] | inside[1] | inside[2])
    assert torch.equal(intersection(a, b, c) <= 0, inside[0] & inside[1] & inside[2])
    assert torch.equal(complement(a) <= 0, ~inside[0])
    assert torch.equal(difference(a, b) <= 0, inside[0] & ~inside[1])


def test_algebra_has_its_laws():
    a, b, c = levels()
    assert torch.equal(complement(union(a, b)), intersection(complement(a), complement(b)))
    assert torch.equal(intersection(a, union(b, c)), union(intersection(a, b), intersection(a, c)))
    assert torch.equal(complement(complement(a)), a)
    assert torch.equal(union(a, a), a)
    assert torch.equal(union(a, b), union(b, a))


def test_band():
    value = torch.arange(-192, 193) / 64
    assert torch.equal(band(value, 0.5, 1.0) <= 0, (value >= -0.5) & (value <= 1.5))


def test_box_maps_corners_and_returns():
    assert torch.equal(BOX.normalize(torch.tensor([BOX.low, BOX.high])), torch.tensor([[-1.0] * 3, [1.0] * 3]))
    x = BOX.expand(2.0).sample(200, torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(BOX.denormalize(BOX.normalize(x)), x, rtol=1e-14, atol=1e-14)
    assert torch.equal(BOX.contains(x), (BOX.normalize(x).abs() <= 1).all(-1))
    assert 0 < BOX.contains(x).sum() < 200


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_are_uniform(dtype):
    """Mean and variance of each axis within five standard errors; everything inside."""
    count = 20_000
    z = BOX.normalize(BOX.sample(count, torch.Generator().manual_seed(0), dtype))
    assert z.dtype == dtype
    assert z.abs().max() <= 1 + 1e-6
    assert (z.mean(0).abs() < 5 * (1 / 3 / count) ** 0.5).all()
    assert ((z.square().mean(0) - 1 / 3).abs() < 5 * (4 / 45 / count) ** 0.5).all()


def test_expand_keeps_the_center():
    assert BOX.expand(3.0) == Box([-3.0, -2.0, -0.5], [3.0, 10.0, 1.0])
    assert BOX.expand(1.0) == BOX
    assert hash(BOX.expand(1.0)) == hash(BOX)
    assert BOX.expand(2.0) != BOX


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ([0.0], [1.0, 2.0], "same length"),
        ([], [], "same length >= 1"),
        ([0.0, 1.0], [1.0, 1.0], "axis 1 needs finite low < high, got low=1.0, high=1.0"),
        ([0.0], [float("inf")], "axis 0"),
        ([float("nan")], [1.0], "axis 0"),
    ],
)
def test_wrong_corners_are_named(low, high, message):
    with pytest.raises(ValueError, match=message):
        Box(low, high)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrap_moves_by_whole_periods_into_the_period(dtype):
    x = uniform(100, 10_000, dtype)
    y = ROUND.wrap(x)
    assert torch.equal(y[:, 0], x[:, 0])
    low, high = torch.tensor([ROUND.low[1], ROUND.high[1]], dtype=dtype)
    assert ((y[:, 1] >= low) & (y[:, 1] < high)).all()
    turns = (x - y)[:, 1] / (2 * math.pi)
    assert (turns - turns.round()).abs().max() < ROUNDING[dtype]
    assert turns.abs().max() > 10
    assert torch.equal(ROUND.wrap(y), y)
    inside = (x[:, 1] >= low) & (x[:, 1] < high)
    assert inside.any()
    assert torch.equal(y[inside], x[inside])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ends_of_the_period_are_one_point(dtype):
    high = torch.tensor(ROUND.high[1], dtype=dtype)
    ends = torch.stack([-high, high, 3 * high, torch.nextafter(-high, -high - 1), torch.nextafter(high, high + 1)])
    y = ROUND.wrap(torch.stack([torch.zeros(5, dtype=dtype), ends], -1))[:, 1]
    assert ((y >= -high) & (y < high)).all()
    # Next to an end, both ends are equally right.
    assert ((high - y.abs()) <= ROUNDING[dtype]).all()
    below = torch.nextafter(high, -high)
    assert ROUND.wrap(torch.stack([high, below]))[1] == below


def test_wrap_has_the_derivative_of_the_identity():
    x = uniform(20, 100).requires_grad_()
    (slope,) = torch.autograd.grad(ROUND.wrap(x).sum(), x)
    assert torch.equal(slope, torch.ones_like(x))


def test_a_box_without_periodic_axes_wraps_nothing():
    x = uniform(20, 10)
    assert Box([-2.0, -1.0], [2.0, 1.0]).wrap(x) is x


def test_contains_and_expand_know_no_edge_of_a_circle():
    x = torch.tensor([[1.9, 50.0], [2.1, 0.0]])
    assert ROUND.contains(x).tolist() == [True, False]
    assert ROUND.expand(3.0) == Box([-6.0, -math.pi], [6.0, math.pi], periodic=[1])
    y = ROUND.expand(0.5).sample(20_000, torch.Generator().manual_seed(0))
    assert y[:, 0].abs().max() <= 1
    assert ((y[:, 1] >= ROUND.low[1]) & (y[:, 1] < ROUND.high[1])).all()
    # Five standard errors of the mean of cos, whose variance is 1/2.
    assert abs(torch.cos(y[:, 1]).mean()) < 5 * (0.5 / len(y)) ** 0.5


def test_periodic_axes_belong_to_equality():
    one, other = Box([0.0, 0.0], [1.0, 1.0]), Box([0.0, 0.0], [1.0, 1.0], periodic=[1])
    assert one.periodic == ()
    assert other.periodic == (1,)
    assert one != other
    assert (repr(one), repr(other)) == ("Box([0.0, 0.0], [1.0, 1.0])", "Box([0.0, 0.0], [1.0, 1.0], periodic=[1])")
    assert Box([0.0] * 3, [1.0] * 3, (2, 0)) == Box([0.0] * 3, [1.0] * 3, [0, 2])
    assert hash(other) == hash(Box([0.0, 0.0], [1.0, 1.0], [1]))


@pytest.mark.parametrize("periodic", [[2], [-1], [0, 0], [True], [0.0], ["1"], "1", 1])
def test_wrong_axes_are_named(periodic):
    with pytest.raises(ArgumentError, match=r"periodic needs a list of different axis numbers from 0 to 1, got .*"):
        Box([0.0, 0.0], [1.0, 1.0], periodic=periodic)
