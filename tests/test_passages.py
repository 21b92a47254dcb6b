"""First passages against the integral of their density, closed forms and paths of many steps.

Statistical tests have fixed seeds.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pirl_rl.crossings import crossing_probability
from pirl_rl.passages import entrance_probability, first_passage, passage_probability


@pytest.mark.parametrize("drift", [-3.0, -0.5, 0.0, 0.5, 3.0])
def test_first_passage_is_the_integral_of_its_density(drift):
    """The density is d / (s sqrt(2 pi t^3)) exp(-(d - m t)^2 / (2 s^2 t)); the integral is over log t."""
    d, s, tau = 0.7, 0.6, 1.5
    log_t = torch.linspace(-12, math.log(tau), 40_001, dtype=torch.float64)
    t = log_t.exp()
    density = d / (s * (2 * math.pi * t**3).sqrt()) * (-((d - drift * t) ** 2) / (2 * s**2 * t)).exp()
    expected = torch.trapezoid(density * t, log_t)
    time, distance = (torch.tensor([number], dtype=torch.float64) for number in (tau, d))
    assert first_passage(time, distance, drift, s).item() == pytest.approx(expected.item(), abs=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_first_passage_is_a_probability_at_extreme_arguments(dtype):
    scales = torch.tensor([0.0, 1e-30, 1e-3, 1.0, 1e6], dtype=dtype)
    drifts = torch.cat([-scales, scales])
    tau, d, m, s = torch.meshgrid(scales, scales, drifts, scales[1:], indexing="ij")
    p = first_passage(tau, d, m, s)
    assert ((p >= 0) & (p <= 1 + torch.finfo(dtype).eps)).all()
    assert torch.equal(p[tau == 0], (d[tau == 0] <= 0).to(dtype))


def test_a_path_leaves_a_wall_with_its_exact_probability():
    """With drift v away from a face at the distance a, 1 - exp(-2 a v / sigma^2) of the paths never cross it."""
    a, v, s, h = torch.tensor([0.01, 0.1, 0.3], dtype=torch.float64), 1.0, 0.5, 50.0
    x, moved = a[:, None], a[:, None] + v * h
    sigma, time = torch.full((3, 1, 1), s, dtype=torch.float64), torch.full((3,), h, dtype=torch.float64)
    crossed = passage_probability(lambda y: y, x, moved, sigma, time)
    torch.testing.assert_close(crossed[:, 0], (-2 * a * v / s**2).exp(), rtol=0, atol=1e-6)
    still = passage_probability(lambda y: y, x, x, sigma * 0, time)
    assert (still == 0).all()


def share_that_enters(x: list[float], moved: list[float], s: list[float], faces: int) -> float:
    """The share of 4,000 paths of 4,000 steps in time 1 at which the first `faces` levels are at most 0 at some time,
    and no other one is before."""
    rng, paths, steps = torch.Generator().manual_seed(0), 4_000, 4_000
    start, end, deviation = (torch.tensor(numbers) for numbers in (x, moved, s))
    at = start.repeat(paths, 1)
    entered, lost = torch.zeros(paths, dtype=torch.bool), torch.zeros(paths, dtype=torch.bool)
    for _ in range(steps):
        at += (end - start) / steps + deviation * torch.randn(at.shape, generator=rng) / steps**0.5
        entered |= (at[:, :faces] <= 0).all(-1) & ~lost
        lost |= (at[:, faces:] <= 0).any(-1)
    return entered.float().mean().item()


@pytest.mark.parametrize(
    ("x", "moved", "s"),
    [
        ([0.5, -0.1], [-0.5, 0.4], [0.1, 0.1]),  # outside of the second face before the first one is crossed
        ([0.1, -0.1], [-0.9, 0.4], [0.1, 0.1]),  # after it
        ([0.3, 0.6], [-0.7, -0.3], [0.3, 0.2]),  # into a corner
        ([0.5, -0.1, 0.2], [-0.5, -0.4, 0.1], [0.2, 0.2, 0.3]),  # past B
        ([0.2, -0.1, 0.5], [-1.0, -0.4, -0.5], [0.1, 0.1, 0.1]),  # into A before B
    ],
)
def test_paths_enter_an_intersection_with_nearly_the_share_of_simulated_ones(x, moved, s):
    """Later crossings of a face are left out. Three standard errors of the share are at most 0.024."""
    start, end = (torch.tensor([numbers], dtype=torch.float64) for numbers in (x, moved))
    sigma, h = torch.diag(torch.tensor(s, dtype=torch.float64))[None], torch.ones(1, dtype=torch.float64)

    def avoid(y: Tensor) -> Tensor:
        return y[:, 2:]

    chance = entrance_probability(lambda y: y[:, :2], avoid if len(x) > 2 else None, start, end, sigma, h).item()
    share = share_that_enters(x, moved, s, 2)
    assert share - 0.05 - 0.024 < chance < share + 0.024


def test_the_entrance_through_one_face_is_a_first_passage():
    x = torch.linspace(0.01, 1, 12, dtype=torch.float64)[:, None]
    sigma, h = torch.full((12, 1, 1), 0.4, dtype=torch.float64), torch.full((12,), 2.0, dtype=torch.float64)
    path = x, x - 0.5, sigma, h
    expected = passage_probability(lambda y: y, *path)[:, 0]
    torch.testing.assert_close(entrance_probability(lambda y: y, None, *path), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_face_whose_level_is_infinite_or_no_number_is_out_of_reach(dtype):
    """Paths start where such levels are infinite or no numbers, step there, or are where their slope is infinite."""
    x = torch.tensor([[-1.0, 0.5], [0.0, 0.5], [0.5, 0.5]], dtype=dtype)
    moved = torch.tensor([[0.5, 0.4], [0.5, 0.4], [-0.5, 0.4]], dtype=dtype)
    sigma, h = torch.full((3, 2, 1), 0.3, dtype=dtype), torch.ones(3, dtype=dtype)
    undefined = (lambda a: torch.where(a > 0, 1 / a, torch.inf), lambda a: 1 / a.clamp(min=0), lambda a: 9 + a.sqrt())

    def wall(y: Tensor) -> Tensor:
        return y[:, 1:]

    def both(y: Tensor) -> Tensor:
        return torch.stack([y[:, 1], *(level(y[:, 0]) for level in undefined)], -1)

    for crossed in (
        passage_probability(both, x, moved, sigma, h),
        crossing_probability(both, x, moved, sigma, h, "nearest"),
    ):
        assert (crossed[:, 1:] < 1e-3).all()
    alone = passage_probability(wall, x, moved, sigma, h)
    assert torch.equal(passage_probability(both, x, moved, sigma, h)[:, :1], alone)
    assert not entrance_probability(wall, both, x, moved, sigma, h).isnan().any()
    assert (entrance_probability(both, None, x, moved, sigma, h) < 1e-3).all()

    def inside(y: Tensor) -> Tensor:
        return torch.stack([y[:, 1], torch.full_like(y[:, 0], -torch.inf)], -1)

    torch.testing.assert_close(
        entrance_probability(inside, None, x, moved, sigma, h), entrance_probability(wall, None, x, moved, sigma, h)
    )
