"""The guard: the distinction of noise and collapse, and the rollback of a run after a collapse."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest
import torch
from small import PHYSICS, assert_same, at_update, interrupt, resumed, small_trainer

from pirl_rl.checkpoint import load
from pirl_rl.continuation import start_from
from pirl_rl.errors import CollapseError, Interrupted
from pirl_rl.guard import Guard
from pirl_rl.run_directory import RunDirectory
from pirl_rl.trainer import Trainer

GUARDED = (
    *(*PHYSICS, "env.crossing=bridge"),
    *("trainer.rollback=true", "evaluation.during=[success]", "evaluation.final=[success]"),
    *("evaluation.success.episodes=1000", "trainer.evaluate_every=10", "trainer.log_every=10"),
    *("trainer.checkpoint_every=25", "trainer.updates=60", "learner.decay=constant", "schedule=constant"),
)
SOUND = "schedule.final=[1,0,1]"


def measured(rate: float, spread: float = 0.3) -> dict[str, float]:
    return {"success_rate": rate, "reward": rate, "value_spread": spread}


# Statistics


@pytest.mark.parametrize("episodes", [64, 10_000])
@pytest.mark.parametrize("rate", [0.003, 0.1, 0.5, 0.9])
def test_equal_rates_are_no_collapse(episodes, rate):
    """1,000 runs of 20 evaluations at one true rate: fewer than 2% of the runs are ended by noise, though the baseline
    is the best of many."""
    drawn = np.random.default_rng(0).binomial(episodes, rate, (1_000, 20)) / episodes
    ended = 0
    for run in drawn:
        guard = Guard(episodes)
        try:
            for found in run:
                guard.judge(measured(found))
        except CollapseError:
            ended += 1
    assert ended < 20


@pytest.mark.parametrize("rate", [0.05, 0.3, 0.95])
def test_half_the_rate_is_a_collapse(rate):
    """Of 10,000 episodes, in each of 200 runs."""
    rng = np.random.default_rng(1)
    for before, after in zip(rng.binomial(10_000, rate, 200), rng.binomial(10_000, rate / 2, 200), strict=True):
        guard = Guard(10_000)
        guard.judge(measured(before / 10_000))
        with pytest.raises(CollapseError, match=r"success_rate from 0\.\d+ to 0\.\d+, reward"):
            guard.judge(measured(after / 10_000))


def test_a_loss_within_the_tolerance_is_endured_but_not_good():
    guard = Guard(10_000, tolerance=0.2)
    assert guard.judge(measured(0.5))
    assert guard.judge(measured(0.49))  # noise
    assert not guard.judge(measured(0.47))
    assert not guard.judge(measured(0.41))  # 18% less
    with pytest.raises(CollapseError):
        guard.judge(measured(0.39))


def test_the_baseline_is_the_best_so_far():
    guard = Guard(10_000)
    for rate in (0.0, 0.3, 0.9, 0.85):
        guard.judge(measured(rate))
    assert guard.baseline == measured(0.9)
    with pytest.raises(CollapseError):
        guard.judge(measured(0.6))


@pytest.mark.parametrize(
    ("before", "now", "collapsed"),
    [(0.4, 0.21, False), (0.4, 0.19, True), (0.4, math.nan, True), (0.15, 0.0, False), (0.1, 0.4, False)],
)
def test_spread_of_the_value(before, now, collapsed):
    guard = Guard(1_000)
    guard.judge(measured(0.5, before))
    if collapsed:
        with pytest.raises(CollapseError, match=f"value_spread from {before} to {now}"):
            guard.judge(measured(0.6, now))
    else:
        guard.judge(measured(0.6, now))


@pytest.mark.parametrize("name", ["reward", "value_spread"])
def test_nan_is_a_collapse(name):
    guard = Guard(100)
    guard.judge(measured(0.5))
    with pytest.raises(CollapseError, match=name):
        guard.judge({**measured(0.5), name: math.nan})


# Training


def last(folder) -> dict:
    return load(folder / RunDirectory.LAST)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A guarded run of 60 updates in which all goes well."""
    folder = tmp_path_factory.mktemp("sound")
    return folder, small_trainer(folder, *GUARDED, SOUND).train()


def test_nothing_changes_while_all_goes_well(sound, tmp_path):
    folder, summary = sound
    small_trainer(tmp_path, *GUARDED, SOUND, "trainer.rollback=false").train()
    assert (folder / "metrics.csv").read_bytes() == (tmp_path / "metrics.csv").read_bytes()
    assert "collapsed_at" not in summary
    assert_same({**last(folder), "rollback": None}, last(tmp_path))


def reverse(trainer: Trainer) -> None:
    """Turn every control into its opposite; training is too slow to turn it back until it is seen."""
    with torch.no_grad():
        for parameter in list(trainer.learner.loss.actor_network_params.parameters())[-2:]:
            parameter.neg_()


def spoil(trainer: Trainer) -> None:
    sample = trainer.batches.boundary.sample
    trainer.batches.boundary.sample = lambda rng, *rest: (batch := sample(rng)).set("value", batch["value"] * math.nan)


def networks(trainer: Trainer) -> dict:
    return {name: entry.clone() for name, entry in trainer.learner.loss.state_dict().items()}


@pytest.mark.parametrize("harm", [reverse, spoil])
def test_a_collapse_ends_with_the_last_good_networks(harm, tmp_path, capfd):
    """A reversed policy loses success, NaN points make the loss diverge; the evaluation of update 30 was good."""
    trainer, good = small_trainer(tmp_path, *GUARDED, SOUND), {}
    at_update(trainer, 31, lambda: (good.update(networks(trainer)), harm(trainer)))
    summary = trainer.train()
    assert summary["rolled_back_to"] == 30
    assert 30 <= summary["collapsed_at"] == summary["updates"] < 60
    assert_same(networks(trainer), good)
    with open(tmp_path / "metrics.csv", newline="") as file:
        rates = {int(row["update"]): float(row["success_rate"]) for row in csv.DictReader(file)}
    assert summary["success_rate"] == pytest.approx(rates[30], abs=1e-8)
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    [line] = [line for line in capfd.readouterr().err.splitlines() if "collapsed" in line]
    assert f"collapsed at update {summary['collapsed_at']}" in line
    assert "update 30 are restored" in line
    again = resumed(tmp_path, *GUARDED, SOUND)
    assert_same(networks(again), good)
    assert again.train() == pytest.approx(summary)


def test_physics_without_a_boundary_flatten_the_value(sound, tmp_path, capfd):
    """Any constant solves L V = 0: with the other terms gone V forgets the target, whatever the policy does."""
    trainer = small_trainer(tmp_path, *GUARDED, "schedule.final=[0,1,0]", "trainer.updates=400")
    start_from(trainer, str(sound[0]))
    before = networks(trainer)
    summary = trainer.train()
    assert summary["rolled_back_to"] < summary["collapsed_at"] < 400
    assert "value_spread from" in capfd.readouterr().err
    if summary["rolled_back_to"] == 0:
        assert_same(networks(trainer), before)


def test_a_killed_run_remembers_its_good_networks(tmp_path):
    """Stopped between the good evaluation and the collapse, and resumed, it ends as if it had run through."""
    through, cut = tmp_path / "through", tmp_path / "cut"
    whole = small_trainer(through, *GUARDED, SOUND)
    at_update(whole, 31, lambda: reverse(whole))
    expected = whole.train()
    first = small_trainer(cut, *GUARDED, SOUND)
    at_update(first, 31, lambda: (reverse(first), interrupt()))
    with pytest.raises(Interrupted):
        first.train()
    summary = resumed(cut, *GUARDED, SOUND).train()
    times = ("wall_seconds", "updates_per_second")
    assert {k: v for k, v in summary.items() if k not in times} == {k: v for k, v in expected.items() if k not in times}
    assert_same(last(cut), last(through))


def test_the_end_of_a_run_is_judged_too(tmp_path):
    """Even where its last evaluation came earlier."""
    trainer = small_trainer(tmp_path, *GUARDED, SOUND, "trainer.updates=59")
    at_update(trainer, 51, lambda: reverse(trainer))
    summary = trainer.train()
    assert (summary["collapsed_at"], summary["rolled_back_to"]) == (59, 50)


@pytest.mark.parametrize("setting", ["trainer.evaluate_every=0", "evaluation.during=[exact]"])
def test_a_guard_without_evaluations_is_refused(setting, tmp_path):
    with pytest.raises(ValueError, match=r"trainer\.rollback: .*trainer\.evaluate_every.*evaluation\.during"):
        small_trainer(tmp_path, *GUARDED, SOUND, setting)


def test_success_measures_the_spread_of_a_known_value(tmp_path):
    trainer = small_trainer(tmp_path, *GUARDED, SOUND)
    [success] = trainer.during.values()
    solution = trainer.solution
    solution.raw_value = lambda tau, x: torch.where(x[:, 0] > 0, 5.0, -5.0)  # starts are uniform: half of each sign
    assert success(solution, trainer.simulator).metrics()["value_spread"] == pytest.approx(0.5, abs=0.01)
    solution.raw_value = lambda tau, x: torch.full_like(tau, 0.3)
    assert success(solution, trainer.simulator).metrics()["value_spread"] == pytest.approx(0, abs=1e-6)
