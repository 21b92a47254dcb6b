"""Schedules of the loss weights."""

from __future__ import annotations

import math

import pytest

from pirl_rl.actor_rules import Hamiltonian
from pirl_rl.losses import PIRLLoss
from pirl_rl.networks import Actor, Critic
from pirl_rl.problems import Reach1D
from pirl_rl.schedules import WEIGHTS, ConstantSchedule, LinearSchedule, LossSchedule

INITIAL, FINAL = (1.0, 0.0, 0.2), (0.0, 1.0, 3.0)
LENGTH = 200_000
SCHEDULES = [
    LossSchedule(INITIAL, FINAL, center=5e4, steepness=1e-4),
    LinearSchedule(INITIAL, FINAL, start=1e4, end=9e4),
    ConstantSchedule(INITIAL, FINAL),
]


@pytest.mark.parametrize("update", [0, 1, 30_000, 50_000, 90_000, 10**9])
def test_sigmoid_is_the_papers_formula(update):
    eta = 1 / (1 + math.exp(min(-1e-4 * (update - 5e4), 700)))
    expected = [a + (b - a) * eta for a, b in zip(INITIAL, FINAL, strict=True)]
    assert SCHEDULES[0](update, LENGTH) == pytest.approx(expected, abs=1e-14)


def test_a_steep_sigmoid_does_not_overflow():
    schedule = LossSchedule(INITIAL, FINAL, center=100, steepness=1e3)
    assert schedule(0, LENGTH) == INITIAL
    assert schedule(100, LENGTH) == pytest.approx([(a + b) / 2 for a, b in zip(INITIAL, FINAL, strict=True)])
    assert schedule(200, LENGTH) == pytest.approx(FINAL)


def test_linear_holds_rises_and_holds():
    schedule = SCHEDULES[1]
    assert schedule(0, LENGTH) == schedule(10_000, LENGTH) == INITIAL
    assert schedule(30_000, LENGTH) == pytest.approx((0.75, 0.25, 0.9))
    assert schedule(90_000, LENGTH) == schedule(10**9, LENGTH) == pytest.approx(FINAL)


def test_constant_is_final_from_the_start():
    assert SCHEDULES[2](0, LENGTH) == SCHEDULES[2](10**6, LENGTH) == FINAL


@pytest.mark.parametrize(
    ("shares", "updates"),
    [
        (LossSchedule(INITIAL, FINAL, 0.25, 20.0), LossSchedule(INITIAL, FINAL, 5e4, 1e-4)),
        (LinearSchedule(INITIAL, FINAL, 0.05, 0.45), LinearSchedule(INITIAL, FINAL, 1e4, 9e4)),
    ],
)
def test_numbers_up_to_one_are_shares_of_the_length(shares, updates):
    for update in (0, 20_000, 50_000, 70_000, LENGTH):
        assert shares(update, LENGTH) == pytest.approx(updates(update, LENGTH), rel=1e-12)
        assert shares.progress(update // 10, LENGTH // 10) == pytest.approx(updates.progress(update, LENGTH), rel=1e-12)


@pytest.mark.parametrize("schedule", SCHEDULES, ids=lambda schedule: type(schedule).__name__)
def test_weights_move_in_place(schedule):
    """The loss keeps its buffers, which compiled code and checkpoints hold on to."""
    problem = Reach1D()
    loss = PIRLLoss(problem, Actor(problem, (4,)), [Critic(problem, (4,)) for _ in range(2)], Hamiltonian(problem))
    buffers = [getattr(loss, key) for key in WEIGHTS]
    for update in (0, 40_000):
        for key, weight in zip(WEIGHTS, schedule(update, LENGTH), strict=True):
            setattr(loss, key, weight)
        assert [buffer.item() for buffer in buffers] == pytest.approx(schedule(update, LENGTH), rel=1e-6)
        assert all(getattr(loss, key) is buffer for key, buffer in zip(WEIGHTS, buffers, strict=True))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ConstantSchedule([1, 0], FINAL), r"schedule.initial: .*\[td, hjb, boundary\], got \[1, 0\]"),
        (lambda: ConstantSchedule(INITIAL, [0, -1, 0]), r"schedule.final: .* got \[0, -1, 0\]"),
        (lambda: ConstantSchedule(INITIAL, [0, math.nan, 0]), "schedule.final"),
        (lambda: LossSchedule(INITIAL, FINAL, 5e4, 0.0), "steepness > 0, got 50000.0 and 0.0"),
        (lambda: LossSchedule(INITIAL, FINAL, math.inf, 1e-4), "finite center"),
        (lambda: LinearSchedule(INITIAL, FINAL, 10, 10), "end > start, got start=10, end=10"),
    ],
)
def test_errors_name_the_key(make, message):
    with pytest.raises(ValueError, match=message):
        make()
