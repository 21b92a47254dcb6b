"""Greedy: its plans after given results, and valid plans for any history."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from rounds import after, fate, history, improves, request

from pirl_rl.outer_loop.advisors.greedy import POWERS, Greedy
from pirl_rl.outer_loop.parsing import parse_plan
from pirl_rl.outer_loop.plan import Candidate


def falls(candidate: Candidate) -> dict:
    return {"metrics": {"reward": 0.5, "calibration_mae": 0.01}}


@pytest.mark.parametrize("seed", range(10))
def test_greedy_plans_for_any_history_and_repeats_nothing(seed):
    rng = np.random.default_rng(seed)
    weights = tuple(rng.choice([0.0, 1e-9, 2e-3, 1.0, 999.0, 1e3], size=3).tolist())
    record = history(weights, jitter=rng.choice([None, 0.0, 0.03, 1.0, 5.0]), reward=rng.choice([0.8, 0.0]))
    advisor, play, seen = Greedy(growth=rng.choice([1.01, 2.0, 10.0])), fate(rng), set()
    for _ in range(12):
        count = int(rng.integers(1, 6))
        asked_now = request(record, candidates=count, updates=int(rng.choice([1, 20_000])))
        answer = advisor.propose(asked_now)
        assert answer == Greedy(growth=advisor.growth).propose(asked_now)
        for candidate in parse_plan(answer, record, count).candidates:
            start = record.checkpoints[candidate.start_checkpoint]
            assert candidate.settings not in seen
            assert candidate.schedule_initial == start.weights
            assert candidate.schedule_final[0] == start.weights[0]
            seen.add(candidate.settings)
        record = after(record, answer, count, play)


def test_greedy_raises_both_weights_from_the_best_checkpoint_while_all_is_well():
    record = history((1.0, 0.0, 0.5))
    for weights in [(1.0, 1e-3, 1.0), (1.0, 2e-3, 2.0), (1.0, 4e-3, 4.0)]:
        start = record.best
        record = after(record, Greedy().propose(request(record)), 1, improves)
        [*_, result] = record.results
        assert result.candidate.start_checkpoint == start.checkpoint
        assert result.candidate.schedule_final == weights
        assert record.best is result


def test_greedy_halves_its_step_after_each_fall_then_holds_then_lowers():
    record, steps = history(), []
    for _ in range(7):
        record = after(record, Greedy().propose(request(record)), 1, falls)
        steps.append(math.log2(record.results[-1].candidate.schedule_final[1] / 0.1))
    assert steps == pytest.approx([1, 1 / 2, 1 / 4, 1 / 8, 0, -1, -2], abs=1e-5)
    assert [result.candidate.name.partition("-")[0] for result in record.results] == ["raise"] * 4 + ["hold"] + [
        "lower"
    ] * 2


@pytest.mark.parametrize("status", ["collapsed", "failed"])
def test_greedy_stays_below_what_fell(status):
    """Candidates of the next round are all milder than the mildest that fell."""
    record = after(history(), Greedy().propose(request(history(), candidates=3)), 3, lambda _: {"status": status})
    mildest = min(result.candidate.schedule_final[1] for result in record.results)
    next_ones = parse_plan(Greedy().propose(request(record, candidates=4)), record, 4).candidates
    assert all(candidate.schedule_final[1] < mildest for candidate in next_ones)


def test_greedy_repeats_nothing_where_even_no_physics_at_all_fell():
    record = history((1.0, 0.0, 0.0))
    for _ in range(20):
        record = after(record, Greedy().propose(request(record, candidates=3)), 3, falls)
    assert len({result.candidate.settings for result in record.results}) == 60


def test_greedy_fans_out():
    finals = [
        c.schedule_final[1]
        for c in parse_plan(Greedy(4.0).propose(request(history(), candidates=3)), history(), 3).candidates
    ]
    assert finals == pytest.approx([0.4, 0.2, 0.1 * 2**0.5], rel=1e-5)


def test_greedy_moves_jitter_gently_holds_it_first_and_takes_it_back():
    record, jitters = history(jitter=0.02), []
    for _ in range(4):
        record = after(record, Greedy().propose(request(record)), 1, falls)
        jitters.append(record.results[-1].candidate.collocation_jitter)
    assert jitters == pytest.approx([0.025, None, 0.016, 0.0128])
    top = history(jitter=0.1)
    assert json.loads(Greedy().propose(request(top)))["candidates"][0].get("collocation_jitter") is None
    weaker = after(
        history(jitter=0.02),
        Greedy().propose(request(history(jitter=0.02))),
        1,
        lambda _: {"metrics": {"reward": 0.795, "calibration_mae": 0.01}},
    )
    assert "collocation_jitter" not in json.loads(Greedy().propose(request(weaker)))["candidates"][0]


def test_greedy_restarts_once_at_most():
    worse = after(
        history(),
        Greedy().propose(request(history())),
        1,
        lambda _: {"metrics": {"reward": 0.9, "calibration_mae": 0.2}},
    )
    starts = [c["start_checkpoint"] for c in json.loads(Greedy().propose(request(worse, candidates=3)))["candidates"]]
    assert starts == ["start", "001/raise-1", "001/raise-1"]


def test_greedy_goes_on_when_all_its_steps_are_used():
    record = history()
    for _ in range(len(POWERS) // 20 + 2):
        record = after(record, Greedy().propose(request(record, candidates=20)), 20, falls)


@pytest.mark.parametrize("setting", [{"growth": 1.0}, {"growth": 11.0}, {"jitter_growth": 1.0}, {"most_jitter": 1.5}])
def test_greedy_refuses(setting):
    with pytest.raises(ValueError, match=next(iter(setting))):
        Greedy(**setting)
