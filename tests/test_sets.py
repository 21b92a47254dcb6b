"""Boxes and the algebra of levels, as properties of random points."""

from __future__ import annotations

import pytest
import torch

from pirl_rl.sets import Box, band, complement, difference, intersection, union

BOX = Box([-1.0, 2.0, 0.0], [1.0, 6.0, 0.5])


def levels(count: int = 3):
    rng = torch.Generator().manual_seed(0)
    return torch.randn(count, 500, generator=rng).unbind(0)


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
