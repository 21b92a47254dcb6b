"""Crossings of faces within a step against quadrature and closed forms.

Statistical tests have fixed seeds and ask for agreement within three standard errors.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pirl_rl.crossings import _crossing_time, crosses_any, crossing_probability, enters_intersection
from pirl_rl.passages import first_passage

DEVIATION = 0.7
PATHS = 200_000


def drawn(
    x: list[float], moved: list[float], seed: int = 0, attempts: int = 1, deviations: tuple[float, ...] | None = None
) -> float:
    """The share of bridges between two states that enter the set x <= 0 within a step of length 1."""
    rng, size = torch.Generator().manual_seed(seed), len(x)
    start, end = (torch.tensor(point, dtype=torch.float64).repeat(PATHS, 1) for point in (x, moved))
    sigma = torch.diag(torch.tensor(deviations or (DEVIATION,) * size, dtype=torch.float64)).expand(PATHS, size, size)
    uniform = torch.rand(attempts, PATHS, size, generator=rng, dtype=torch.float64)
    normal = torch.randn(attempts, 2, PATHS, size, generator=rng, dtype=torch.float64) if size > 1 else None
    h = torch.ones(PATHS, dtype=torch.float64)
    return enters_intersection(lambda y: y, start, end, sigma, h, uniform, normal).double().mean().item()


def crossed_before(t: float, a: float, b: float) -> float:
    """The probability that a bridge from a > 0 to b in time 1 is at 0 before t, by quadrature over its state at t."""
    spread = DEVIATION * math.sqrt(t * (1 - t))
    z = torch.linspace(-9, 9, 20_001, dtype=torch.float64)
    y = (1 - t) * a + t * b + spread * z
    there = torch.where(y > 0, (-2 * a * y.clamp(min=0) / (DEVIATION**2 * t)).exp(), torch.ones_like(y))
    return torch.trapezoid(there * (-(z**2) / 2).exp() / math.sqrt(2 * math.pi), z).item()


def assert_agrees(rate: float, probability: float):
    assert abs(rate - probability) <= 3 * math.sqrt(probability * (1 - probability) / PATHS) + 1e-9


@pytest.mark.parametrize(("a", "b"), [(0.3, 0.4), (0.5, -0.2), (0.02, 0.6), (0.6, 1e-7), (0.8, -1.5)])
@pytest.mark.parametrize("t", [0.2, 0.5, 0.9])
def test_a_face_is_crossed_by_the_law_of_the_bridge(a, b, t):
    """The second face moves without noise and opens, or closes, at the time t: it tells when the first is crossed."""
    noise = (DEVIATION, 0.0)
    closes = drawn([a, -t], [b, 1 - t], deviations=noise)
    assert_agrees(closes, crossed_before(t, a, b))
    # A path that is outside when the second face opens, and enters later, is missed.
    opens = drawn([-a, t], [-b, t - 1], seed=1, deviations=noise)
    inside = torch.special.ndtr(torch.tensor(((1 - t) * a + t * b) / (DEVIATION * math.sqrt(t * (1 - t)))))
    assert_agrees(opens, inside.item())


@pytest.mark.parametrize(("a", "b"), [(0.3, 0.4), (1.0, 2.0), (0.5, -0.2)])
def test_one_face_has_the_probability_of_the_bridge(a, b):
    assert_agrees(drawn([a], [b]), min(1.0, math.exp(-2 * a * max(b, 0) / DEVIATION**2)))


def fine_share(x: list[float], moved: list[float], steps: int = 400, paths: int = 20_000) -> float:
    """The share of bridges that enter the quadrant x <= 0 at one of many points, or at a face between two of them.

    Between two points a face counts where the other constraint holds at both.
    """
    rng = torch.Generator().manual_seed(5)
    now, end = (torch.tensor(point, dtype=torch.float64).repeat(paths, 1) for point in (x, moved))
    entered = torch.zeros(paths, dtype=torch.bool)
    for left in range(steps, 0, -1):
        spread = DEVIATION * math.sqrt((left - 1) / left / steps)
        later = now + (end - now) / left + spread * torch.randn(now.shape, generator=rng, dtype=torch.float64)
        crosses = (
            torch.rand(now.shape, generator=rng, dtype=torch.float64) < (-2 * now * later * steps / DEVIATION**2).exp()
        )
        held, outside = (now <= 0) & (later <= 0), (now > 0) & (later > 0)
        entered |= (later <= 0).all(-1) | (crosses & outside & held.flip(-1)).any(-1)
        now = later
    return entered.double().mean().item()


@pytest.mark.parametrize(
    ("x", "moved", "missed"),
    [([0.3, -0.4], [0.2, 0.3], 0.04), ([0.3, 0.3], [-0.3, 0.1], 0.14), ([0.3, -1], [0.2, -1], 0)],
)
def test_a_corner_is_entered_as_often_as_along_many_points(x, moved, missed):
    """Two attempts miss paths that leave the corner twice; with many attempts nothing is missed.

    Between 400 points up to 0.006 of the paths enter unseen.
    """
    fine = fine_share(x, moved)
    noise = 3 * math.sqrt(fine * (1 - fine) * (1 / 20_000 + 1 / PATHS))
    assert fine - missed - noise <= drawn(x, moved, attempts=2) <= fine + 0.006 + noise
    assert fine - noise <= drawn(x, moved, attempts=16) <= fine + 0.006 + noise


def test_faces_of_many_constraints_need_no_product_of_them():
    """A thousand constraints of which one is crossed for certain: all others hold far from their faces."""
    x, moved = torch.full((4, 1_000), -50.0), torch.full((4, 1_000), -50.0)
    x[:, 0], moved[:, 0] = 0.5, -0.5
    rng, sigma = torch.Generator().manual_seed(0), torch.ones(4, 1_000, 1)
    uniform, normal = torch.rand(2, *x.shape, generator=rng), torch.randn(2, 2, *x.shape, generator=rng)
    assert enters_intersection(lambda y: y, x, moved, sigma, torch.ones(4), uniform, normal).all()


def test_extreme_levels_give_no_nan():
    """Levels from 1e-30 to 1e6 with noise of any size enter or not, as their ends say, where noise is far smaller."""
    scales = torch.tensor([1e-30, 1e-12, 1e-3, 1.0, 1e6])
    a, b, s = (
        entry.flatten() for entry in torch.meshgrid(scales, scales, torch.tensor([0.0, 1e-6, 1.0, 1e4]), indexing="ij")
    )
    x, moved = torch.stack([a, -a], -1), torch.stack([-b, -b], -1)
    sigma, h, rng = s[:, None, None].expand(-1, 2, 1), torch.ones_like(a), torch.Generator().manual_seed(0)
    uniform, normal = torch.rand(2, *x.shape, generator=rng), torch.randn(2, 2, *x.shape, generator=rng)
    entered = enters_intersection(lambda y: y, x, moved, sigma, h, uniform, normal)
    sure = s <= 1e-3 * torch.minimum(a, b)
    assert sure.sum() > (s == 0).sum()
    assert entered[sure].all()
    back: Tensor = enters_intersection(lambda y: y, x, -moved, sigma, h, uniform, normal)
    assert not back[sure].any()
    # A NaN would read as "not entered" where the noise decides, so that the times themselves are looked at.
    time = _crossing_time(x, moved, (s**2)[:, None].expand_as(x), uniform[0], normal[0, 0])
    assert ((time >= 0) & (time <= 1)).all()


def test_any_face_is_enough_for_a_union():
    x, moved = torch.tensor([[0.5, 9.0], [9.0, 9.0]]), torch.tensor([[1e-9, 9.0], [9.0, 9.0]])
    sigma, uniform = torch.ones(2, 2, 1), torch.full((2, 2), 0.5)
    assert crosses_any(lambda y: y, x, moved, sigma, torch.ones(2), uniform).tolist() == [True, False]


def test_bridges_with_random_ends_cross_with_the_probability_of_a_first_passage():
    """The mean over the normal distribution of the ends is taken at 20,001 equidistant quantiles."""
    a, v, s, h = 0.3, 0.4, 0.5, 2.0
    quantiles = (torch.arange(20_001, dtype=torch.float64) + 0.5) / 20_001
    moved = a + v * h + s * h**0.5 * torch.special.ndtri(quantiles)[:, None]
    sigma, time = torch.full((20_001, 1, 1), s, dtype=torch.float64), torch.full((20_001,), h, dtype=torch.float64)
    crossed = crossing_probability(lambda y: y, torch.full_like(moved, a), moved, sigma, time, "nearest")
    passage = first_passage(*torch.tensor([h, a, -v, s], dtype=torch.float64))
    torch.testing.assert_close(crossed.mean(), passage, rtol=0, atol=1e-4)
    without_noise = crossing_probability(lambda y: y, moved.abs() + 1, moved.abs() + 2, sigma * 0, time, "nearest")
    assert (without_noise == 0).all()


def test_a_path_goes_past_a_set_that_it_cannot_touch():
    """The level x^2 + c is above 0 everywhere, and c is far below its change in a step."""
    rng, c = torch.Generator().manual_seed(0), 1e-4
    x = torch.linspace(0.02, 0.1, 50, dtype=torch.float64).repeat(200)[:, None]
    moved = x + 0.05 * torch.randn(x.shape, generator=rng, dtype=torch.float64)
    sigma, time = torch.full((len(x), 1, 1), 0.05, dtype=torch.float64), torch.ones(len(x), dtype=torch.float64)
    for decisive in ("nearest", "farthest"):
        crossed = crossing_probability(lambda y: y.square() + c, x, moved, sigma, time, decisive)
        assert (crossed == 0).all()


@pytest.mark.parametrize("faces", [1, 2])
@pytest.mark.parametrize(("power", "tolerance"), [(0.5, 0.02), (2.0, 1e-12), (3.0, 0.02)])
def test_a_curved_level_is_crossed_like_the_distance(power, tolerance, faces):
    """The levels (1 + d)^p - 1 are 0 where the distance d is, and parabolas for p = 2. Tangents alone are wrong by 0.07
    to 0.25."""
    rng = torch.Generator().manual_seed(0)
    x = 0.3 * torch.rand(2_000, 1, generator=rng, dtype=torch.float64) + 0.01
    moved = (x + 0.2 * torch.randn(x.shape, generator=rng, dtype=torch.float64)).abs()
    sigma, time = torch.full((len(x), 1, 1), 0.2, dtype=torch.float64), torch.ones(len(x), dtype=torch.float64)

    def levels(d: Tensor) -> Tensor:
        bent = (1 + d).clamp(min=1e-6) ** power - 1
        return torch.cat([bent, d + 9], -1)[:, :faces]

    expected = (-2 * x * moved / 0.2**2).exp()
    crossed = crossing_probability(levels, x, moved, sigma, time, "nearest")[:, :1]
    torch.testing.assert_close(crossed, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_levels_without_a_tangent_give_probabilities(dtype):
    """Levels that are 0, do not change, have no noise, or are no numbers where the tangent is 0."""
    x = torch.tensor([[0.5, 0.2], [1e-30, 1e-30], [3.0, 1e-3]], dtype=dtype)
    sigma, time = torch.diag(torch.tensor([0.3, 0.0], dtype=dtype)).expand(3, 2, 2), torch.ones(3, dtype=dtype)

    def levels(y: Tensor) -> Tensor:
        return torch.stack([y[:, 0] * 0, y[:, 1], (y[:, 0] + 1e-3).log() + 80, y[:, 0].clamp(max=1) * 1e-20], -1)

    for decisive in ("nearest", "farthest"):
        crossed = crossing_probability(levels, x, x + 0.1, sigma, time, decisive)
        assert ((crossed >= 0) & (crossed <= 1)).all()
    uniform, normal = torch.full((2, 3, 4), 0.5, dtype=dtype), torch.zeros(2, 2, 3, 4, dtype=dtype)
    inside = lambda y: torch.stack([y[:, 0] * 0, y[:, 0] - 9], -1)  # noqa: E731
    assert enters_intersection(inside, x, x + 0.1, sigma, time, uniform[..., :2], normal[..., :2]).all()
