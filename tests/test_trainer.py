"""The trainer: exact continuation, repeatability, and how it stops."""

from __future__ import annotations

import copy
import csv
import math

import pytest
import torch
from small import EVENTS, PHYSICS, assert_same, at_update, interrupt, resumed, small_config, small_trainer

from pirl_rl.assembly import make_trainer
from pirl_rl.checkpoint import load
from pirl_rl.errors import CheckpointError, DivergenceError, Interrupted
from pirl_rl.run_directory import RunDirectory
from pirl_rl.schedules import WEIGHTS


def last(folder) -> dict:
    return load(folder / RunDirectory.LAST)


def metrics(folder) -> bytes:
    return (folder / "metrics.csv").read_bytes()


@pytest.fixture(
    scope="module", params=["false", pytest.param("true", marks=pytest.mark.slow)], ids=["eager", "compiled"]
)
def whole(request, tmp_path_factory):
    """An uninterrupted run: its folder and the override that tells how it ran."""
    folder = tmp_path_factory.mktemp("whole")
    small_trainer(folder, compiled := f"compile={request.param}").train()
    return folder, compiled


@pytest.mark.parametrize("stop", [7, 8, 10, 19], ids="stopped at {}".format)
def test_stop_and_resume_is_bit_identical(whole, stop, tmp_path):
    folder, compiled = whole
    first = small_trainer(tmp_path, compiled)
    at_update(first, stop, interrupt)
    with pytest.raises(Interrupted, match=str(stop)):
        first.train()
    second = resumed(tmp_path, compiled)
    assert second.update == stop
    second.train()
    assert_same(last(tmp_path), last(folder))
    assert metrics(tmp_path) == metrics(folder)


def test_rows_after_the_checkpoint_are_written_again(whole, tmp_path):
    folder, compiled = whole
    first = small_trainer(tmp_path, compiled)

    def die():
        raise OSError("power failure")

    at_update(first, 15, die)
    with pytest.raises(OSError):
        first.train()
    assert last(tmp_path)["update"] == 10
    with open(tmp_path / "metrics.csv", "a") as file:
        file.write("15,0.9")  # a row that the kill cut short
    resumed(tmp_path, compiled).train()
    assert_same(last(tmp_path), last(folder))
    assert metrics(tmp_path) == metrics(folder)


def test_more_updates_than_first_asked_for(tmp_path):
    constant = ("learner.decay=constant", "schedule=constant", "pirl.stages=[]")
    long, short = tmp_path / "long", tmp_path / "short"
    small_trainer(long, *constant, "trainer.updates=20").train()
    small_trainer(short, *constant, "trainer.updates=10").train()
    resumed(short, *constant, "trainer.updates=20").train()
    assert_same(last(short), last(long))


def test_a_checkpoint_of_other_networks_is_refused(tmp_path):
    small_trainer(tmp_path, "trainer.updates=2").train()
    with pytest.raises(CheckpointError, match="does not fit"):
        resumed(tmp_path, "critic.hidden=[8]")


def test_seed_and_evaluation(whole, tmp_path):
    folder, compiled = whole
    small_trainer(tmp_path / "same", compiled).train()
    assert metrics(tmp_path / "same") == metrics(folder)
    small_trainer(tmp_path / "other", compiled, "seed=1").train()
    assert metrics(tmp_path / "other") != metrics(folder)
    quiet = tmp_path / "quiet"
    small_trainer(quiet, compiled, "trainer.evaluate_every=0", "trainer.checkpoint_every=0").train()
    assert_same(last(quiet), last(folder))


def test_rows_hold_the_weights_losses_and_evaluations(whole):
    with open(whole[0] / "metrics.csv", newline="") as file:
        rows = {int(row["update"]): row for row in csv.DictReader(file)}
    assert list(rows) == [1, 3, 4, 6, 8, 9, 12, 15, 16, 18, 20]
    assert {update for update, row in rows.items() if row["value_mse"]} == {1, 4, 8, 12, 16, 20}
    assert all(math.isfinite(float(row["loss_actor"])) for row in rows.values())
    assert float(rows[20]["learning_rate"]) < float(rows[1]["learning_rate"])


def batch(trainer, k: int):
    """The batch of an update."""
    return trainer.batches.sample(trainer.curriculum.weights(k), trainer.curriculum.progress(k))


def test_a_term_is_left_out_while_its_weight_is_negligible(tmp_path):
    """A sigmoid of steepness 5 is 4e-6 at 2.5 updates before its center, and below 1e-6 at 3 before."""
    trainer = small_trainer(tmp_path, *PHYSICS, "schedule.center=9.5", "schedule.steepness=5")
    trainer.collector.start()
    parts = []
    for k in range(20):
        parts.append("collocation" in batch(trainer, k).keys())
    assert parts == [False] * 7 + [True] * 13


def test_terms_without_weight_are_left_out(tmp_path):
    kept = {"td3": {"td_loss"}, "pinn": {"hjb_loss", "boundary_loss"}, "pirl": {"td_loss"}}
    for method, terms in kept.items():
        trainer = small_trainer(tmp_path / method, f"method={method}")
        trainer.collector.start()
        assert set(trainer.learner.loss.critic_loss(batch(trainer, 0))[1]) == terms


def test_nan_stops_with_update_and_term(tmp_path):
    trainer = small_trainer(tmp_path, "method=pinn")
    sample = trainer.batches.collocation.sample

    def spoil():
        trainer.batches.collocation.sample = lambda rng, *rest: sample(rng).apply(
            lambda x: x * math.nan if x.is_floating_point() else x
        )

    at_update(trainer, 13, spoil)
    with pytest.raises(DivergenceError, match=r"update 13: hjb_loss.*checkpoint of update 10 is kept"):
        trainer.train()
    kept = resumed(tmp_path, "method=pinn")
    assert kept.update == 10
    assert all(parameter.isfinite().all() for parameter in kept.learner.loss.parameters())


def test_explosion_stops_with_update_and_term(tmp_path):
    trainer = small_trainer(tmp_path, *PHYSICS, "method=fixed")
    at_update(trainer, 6, lambda: scale_boundary(trainer, 1e5))
    with pytest.raises(DivergenceError, match=r"update 6: boundary_loss.*update 5 is kept"):
        trainer.train()


def scale_boundary(trainer, factor: float) -> None:
    sample = trainer.batches.boundary.sample
    trainer.batches.boundary.sample = lambda rng, *rest: (batch := sample(rng)).set(
        "value", batch["value"] * factor + factor
    )


def test_spoilt_networks_are_not_saved(tmp_path):
    trainer = small_trainer(tmp_path)
    trainer.save()
    before = (tmp_path / RunDirectory.LAST).read_bytes()
    with torch.no_grad():
        next(trainer.learner.loss.actor_network_params.parameters()).fill_(math.nan)
    with pytest.raises(DivergenceError, match="actor"):
        trainer.save()
    assert (tmp_path / RunDirectory.LAST).read_bytes() == before


def test_progress_shows_figures_without_a_terminal(tmp_path, capfd):
    small_trainer(tmp_path).train()
    assert "update 4/20: value_mse" in capfd.readouterr().err
    small_trainer(tmp_path / "quiet", "trainer.evaluate_every=0").train()
    assert "update 3/20: train_td_loss" in capfd.readouterr().err


@pytest.mark.parametrize("compile", ["false", pytest.param("true", marks=pytest.mark.slow)])
def test_an_update_is_a_step_of_the_optimiser_along_the_gradient_of_backward(compile, tmp_path):
    """Gradients are in the memory order of their parameters, which fused optimisers take for granted."""
    trainer = small_trainer(tmp_path, *PHYSICS, f"compile={compile}")
    trainer.collector.start()
    learner, weights = trainer.learner, (1.0, 1.0, 1.0)
    batch = trainer.batches.sample(weights, 0.0)
    expected = copy.deepcopy(learner.loss)
    for name, value in zip(WEIGHTS, weights, strict=True):
        setattr(expected, name, value)
    expected.critic_loss(batch)[0].backward()
    torch.optim.Adam(expected.qvalue_network_params.parameters(), learner.rate(0.0)).step()
    learner.update(batch, 1, weights, 0.0)
    pairs = zip(
        learner.loss.qvalue_network_params.parameters(), expected.qvalue_network_params.parameters(), strict=True
    )
    assert all(torch.allclose(one, other, atol=1e-5) for one, other in pairs)


def test_training_in_memory_is_not_checked_at_each_update_once_a_checkpoint_is_late(monkeypatch):
    trainer, checks = make_trainer(small_config(*EVENTS, "trainer.checkpoint_every=0")), []
    monkeypatch.setattr(trainer.learner, "check", checks.append)
    trainer.update, trainer._saved_at = 7, -math.inf
    for _ in range(3):
        trainer.keep(stop=False)
    assert checks == [7]


def test_a_run_that_goes_on_has_no_summary_of_earlier_networks(tmp_path):
    small_trainer(tmp_path, "trainer.updates=6").train()
    run = RunDirectory(tmp_path)
    run.evaluation.write_text("{}")
    again = resumed(tmp_path, "trainer.updates=12")
    at_update(again, 9, interrupt)
    with pytest.raises(Interrupted):
        again.train()
    assert not run.summary.exists()
    assert not run.evaluation.exists()
    resumed(tmp_path, "trainer.updates=12").train()
    assert run.numbers()["updates"] == 12
