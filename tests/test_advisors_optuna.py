"""Optuna: it learns from results, is deterministic, and has a valid plan for any history."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from rounds import after, fate, history, request

from pirl_rl.outer_loop.advisors.greedy import Greedy
from pirl_rl.outer_loop.advisors.optuna import Optuna
from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.parsing import parse_plan
from pirl_rl.outer_loop.plan import Candidate


def valley(candidate: Candidate) -> dict:
    """Error least at HJB weight 0.1 and boundary weight 0.01; large weights collapse."""
    _, hjb, boundary = candidate.schedule_final
    if hjb > 3:
        return {"status": "collapsed", "metrics": {}}
    error = 0.01 + 0.02 * ((math.log10(hjb) + 1) ** 2 + (math.log10(boundary) + 2) ** 2)
    return {"metrics": {"reward": 0.8, "calibration_mae": error}}


def searched(advisor, rounds: int, jitter=None) -> History:
    record = history(jitter=jitter)
    for _ in range(rounds):
        record = after(record, advisor.propose(request(record, candidates=3)), 3, valley)
    return record


def test_optuna_improves_on_its_start_and_repeats_itself_exactly():
    record = searched(Optuna(), 8)
    assert record.best.metrics["calibration_mae"] < 0.3 * record.baseline.metrics["calibration_mae"]
    assert searched(Optuna(), 8) == record
    assert searched(Optuna(seed=1), 1) != searched(Optuna(), 1)


def test_no_round_of_a_seed_repeats_one_of_another():
    weights = []
    for seed in range(4):
        advisor, record = Optuna("random", seed=seed), history()
        for _ in range(4):
            one = json.loads(advisor.propose(request(record, candidates=1)))["candidates"][0]
            weights.append(tuple(one["schedule_final"]))
            record = after(record, json.dumps({"round_note": "", "candidates": [one]}), 1, valley)
    assert len(set(weights)) == len(weights)


def test_optuna_learns_from_the_record_and_random_does_not():
    """The same candidates with their errors in reverse order."""
    for sampler, same in [("tpe", False), ("random", True)]:
        record = searched(Optuna(sampler), 3)
        turned = record.model_copy(
            update={
                "rounds": [
                    one.model_copy(update={"results": [_turned(r) for r in one.results]}) for one in record.rounds
                ]
            }
        )
        weights = [
            [
                c["schedule_final"][1:]
                for c in json.loads(Optuna(sampler).propose(request(one, candidates=3)))["candidates"]
            ]
            for one in (record, turned)
        ]
        assert (weights[0] == weights[1]) == same


def _turned(result: Result) -> Result:
    error = result.metrics.get("calibration_mae")
    return (
        result
        if error is None
        else result.model_copy(update={"metrics": {"reward": 0.8, "calibration_mae": 1 - error}})
    )


@pytest.mark.parametrize("seed", range(4))
def test_optuna_plans_for_any_history(seed):
    rng = np.random.default_rng(seed)
    weights = tuple(rng.choice([0.0, 2e-3, 1.0, 1e3], size=3).tolist())
    record, play = history(weights, jitter=rng.choice([None, 0.0, 5.0])), fate(rng)
    for number in range(6):
        advisor = Greedy() if number == 2 else Optuna(rng.choice(["tpe", "random"]))  # whose candidates leave the space
        answer = advisor.propose(request(record, candidates=3, updates=int(rng.choice([1, 20_000]))))
        for candidate in parse_plan(answer, record, 3).candidates:
            start = record.checkpoints[candidate.start_checkpoint]
            assert (candidate.schedule_initial, candidate.schedule_final[0]) == (start.weights, start.weights[0])
        record = after(record, answer, 3, play)


def test_optuna_searches_the_collocation_only_where_there_is_one():
    [with_it, without] = [
        json.loads(Optuna().propose(request(history(jitter=j))))["candidates"][0] for j in (0.02, None)
    ]
    assert 0 <= with_it["collocation_jitter"] <= 0.1
    assert 0.5 <= with_it["collocation_replay_share"] <= 1
    assert not {"collocation_jitter", "collocation_replay_share"} & without.keys()


@pytest.mark.parametrize(
    "setting",
    [{"sampler": "grid"}, {"seed": -1}, {"startup": 0}, {"weights": [0, 1]}, {"weights": [1]}, {"jitter": 2.0}],
)
def test_optuna_refuses(setting):
    with pytest.raises(ValueError, match=next(iter(setting))):
        Optuna(**setting)
