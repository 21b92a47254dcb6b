"""Stages: their starts, their shares of a run, and the settings that the trainer takes from them."""

from __future__ import annotations

import math
from contextlib import nullcontext

import pytest
import torch
from small import assert_same, at_update, interrupt, resumed, small_trainer

from pirl_rl import checkpoint
from pirl_rl.actor_rules import BestControl, ClippedSurrogate, LookAhead
from pirl_rl.curriculum import Curriculum, Stage
from pirl_rl.errors import ConfigError, Interrupted
from pirl_rl.loggers import read_metrics
from pirl_rl.run_directory import RunDirectory
from pirl_rl.schedules import ConstantSchedule, LinearSchedule, LossSchedule

WHOLE = LossSchedule([1, 0, 0], [0, 1, 1], center=50, steepness=0.1)


def test_without_schedules_of_their_own_stages_leave_the_run_s():
    curriculum = Curriculum(WHOLE, 100, [Stage(1), Stage(3)])
    for k in (0, 24, 25, 99, 100):
        assert curriculum.weights(k) == WHOLE(k, 100)
        assert curriculum.progress(k) == WHOLE.progress(k, 100)


@pytest.mark.parametrize("updates", [7, 40, 90, 4_000_000])
def test_stages_stretch_to_the_run(updates):
    """A run of any length sees the same weights at the same fraction of it."""
    ramp = LinearSchedule([1, 0, 0], [1, 2, 2], start=0, end=1)
    stages = [Stage(1, ConstantSchedule([1, 0, 0], [1, 0, 0])), Stage(3, ramp)]
    curriculum = Curriculum(WHOLE, updates, stages)
    first = math.ceil(updates / 4)
    for k in range(0, updates, max(1, updates // 50)):
        assert curriculum.index(k) == (k >= first)
        assert curriculum.weights(k)[1] == pytest.approx(max(0.0, 2 * (k - first) / (updates - first)), abs=1e-9)
    assert curriculum.index(updates) == 1


def test_a_stage_s_schedule_counts_the_stage_s_own_updates():
    """As the run's schedule counts those of the run: a number above 1 is an update, whatever the other stages are."""
    own = LossSchedule([1, 0, 0], [0, 1, 1], center=10, steepness=0.3)
    curriculum = Curriculum(WHOLE, 100, [Stage(1), Stage(3, own)])
    for k in (25, 30, 35, 99):
        assert curriculum.weights(k) == own(k - 25, 75)
        assert curriculum.progress(k) == own.progress(k - 25, 75)


def test_a_stage_may_be_too_short_for_an_update():
    """Two updates for three stages leave none to the last, whose weights are asked for all the same."""
    own = LossSchedule([1, 0, 0], [0, 1, 1], center=0.5, steepness=10)
    curriculum = Curriculum(WHOLE, 2, [Stage(1), Stage(1), Stage(0.5, own, learning_rate=0.1)])
    assert len(curriculum.largest_weights()) == 3
    assert curriculum.decay(2) == 0


def test_each_stage_has_one_first_update():
    curriculum = Curriculum(WHOLE, 30, [Stage(1)] * 3)
    assert [k for k in range(30) if curriculum.is_first(k)] == [0, 10, 20]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Stage(0), "stage.share: expected a number > 0, got 0"),
        (lambda: Stage(1, actor_every=0), "stage.actor_every"),
        (lambda: Stage(1, learning_rate=0.0), "stage.learning_rate: expected a number > 0"),
        (lambda: Curriculum(WHOLE, 10, []), "at least one stage"),
    ],
)
def test_errors(make, message):
    with pytest.raises(ValueError, match=message):
        make()


STAGES = (
    "stages=[{share: 1, "
    "initial_states: {_target_: pirl_rl.sampling.initial_states.UniformStates, low: [0], high: [1]}},"
    "{share: 1, actor_every: 5, n_steps: 3, "
    "actor_rule: {_target_: pirl_rl.actor_rules.LookAhead, steps: 4}, "
    "collocation: {_target_: pirl_rl.sampling.collocation.ReplayCollocation, size: 7}}]",
    "trainer.updates=10",
)


def test_the_trainer_takes_over_what_a_stage_sets(tmp_path):
    trainer = small_trainer(tmp_path, *STAGES)
    seen = []
    step = trainer.collector.step

    def watch(k):
        law = getattr(trainer.collector.initial_states, "box", None)
        rates = trainer.collector.n_steps, trainer.learner.actor_every, type(trainer.learner.loss.actor_rule)
        seen.append((law and law.low, trainer.batches.collocation.size, *rates))
        step(k)

    trainer.collector.step = watch
    trainer.train()
    size = small_trainer(tmp_path / "other", *STAGES).batches.collocation.size
    assert seen == [((0.0,), size, 1, 2, BestControl)] * 5 + [(None, 7, 3, 5, LookAhead)] * 5


POLICY = (
    "stages=[{share: 1, n_steps: 4}, {share: 2, exploration_noise: 0.3, "
    "actor_rule: {_target_: pirl_rl.actor_rules.ClippedSurrogate, deviation: 0.3}}, "
    "{share: 1, exploration_noise: 0.1}]",
    "trainer.updates=12",
)


@pytest.mark.parametrize(
    ("stages", "stop", "end"),
    [(STAGES, 3, 10), (STAGES, 7, 10), (POLICY, 6, 12), ((*POLICY, "trainer.checkpoint_every=3"), 3, 12)],
    ids=["own", "run", "noise", "noise begins"],
)
def test_resume_inside_a_stage_is_exact(stages, stop, end, tmp_path):
    small_trainer(tmp_path / "whole", *stages).train()
    stopped = small_trainer(tmp_path / "cut", *stages)
    at_update(stopped, stop, interrupt)
    with pytest.raises(Interrupted):
        stopped.train()
    resumed(tmp_path / "cut", *stages).train()
    ends = [checkpoint.load(tmp_path / name / RunDirectory.LAST) for name in ("whole", "cut")]
    assert ends[0]["update"] == end
    assert_same(*ends)


@pytest.mark.parametrize("collector", ["sync", pytest.param("multi_async", marks=pytest.mark.slow)])
def test_a_stage_of_policy_gradients_follows_its_own_noise_alone(collector, tmp_path):
    trainer = small_trainer(tmp_path, *POLICY, f"collector={collector}", "collector.warmup_frames=128")
    seen = []

    def watch(weights, progress):
        loss, replay = trainer.learner.loss, trainer.collector.buffer[:]
        with getattr(trainer.collector, "_write_lock", nullcontext()):  # without it, rows may be half written
            off = (replay["action"] - replay["loc"]).abs()
        seen.append((type(loss.actor_rule), trainer.collector.exploration_noise, len(replay) >= 128, off.amax().item()))
        return sample(weights, progress)

    sample, trainer.batches.sample = trainer.batches.sample, watch
    trainer.train()
    rules = [(BestControl, 0.0, True)] * 3 + [(ClippedSurrogate, 0.3, True)] * 6 + [(BestControl, 0.1, True)] * 3
    assert [one[:3] for one in seen] == rules
    assert [off for *_, off in seen[:3]] == [0.0] * 3
    assert all(0.5 < off < 2.0 for *_, off in seen[3:9])
    assert all(0.1 < off < 0.6 for *_, off in seen[9:])


def test_a_new_rule_starts_with_fresh_moments(tmp_path):
    trainer, steps = small_trainer(tmp_path, *POLICY, "learner.actor_every=1"), {}
    for update in (3, 5, 9, 11):
        at_update(trainer, update, lambda u=update: steps.update({u: _steps(trainer.learner.actor_optimizers[0])}))
    trainer.train()
    assert steps == {3: {2.0}, 5: {1.0}, 9: {5.0}, 11: {1.0}}


def _steps(optimizer: torch.optim.Optimizer) -> set[float]:
    return {state["step"].item() for state in optimizer.state.values()}


@pytest.mark.parametrize(
    ("stage", "message"),
    [
        (
            "{share: 1, actor_rule: {_target_: pirl_rl.actor_rules.ClippedSurrogate, deviation: 0.2}}",
            r"exploration_noise = 0\.0, got 0\.2",
        ),
        ("{share: 1, actor_rule: {_target_: pirl_rl.actor_rules.Q}}", "expected critic.action_input=true, got false"),
        ("{share: 1, actor_rule: {_target_: pirl_rl.actor_rules.SAC}}", "cannot load pirl_rl.actor_rules.SAC"),
        ("{share: 1, actor_rule: q}", "stages.1..actor_rule: expected"),
        ("{share: 1, exploration_noise: -0.1}", "exploration_noise: expected a number >= 0, got -0.1"),
    ],
)
def test_a_stage_that_cannot_be_followed_is_refused_at_the_start(stage, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        small_trainer(tmp_path, *POLICY, f"stages=[{{share: 1}}, {stage}]")


def test_a_frozen_actor_stays_while_the_critics_and_their_targets_move(tmp_path):
    trainer = small_trainer(tmp_path, "stages=[{share: 1}, {share: 1, train_actor: false}]", "trainer.updates=10")
    loss, half = trainer.learner.loss, {}
    at_update(trainer, 7, lambda: half.update({name: entry.clone() for name, entry in loss.state_dict().items()}))
    trainer.train()
    for name, entry in loss.state_dict().items():
        if name.endswith("weight") and "network" in name:
            frozen = name.startswith(("actor", "target_actor"))
            assert torch.equal(entry, half[name]) == frozen, name


def test_an_actor_is_frozen_at_the_mean_of_its_parameters(tmp_path):
    """Its updates j = 0, 1, ... have the weights that rates of at least 1/(1 + j) and of 0.3 give them."""
    settings = ("stages=[{share: 2}, {share: 1, train_actor: false}]", "trainer.updates=18", "learner.actor_polyak=0.3")
    trainer = small_trainer(tmp_path, *settings)
    loss, step, seen = trainer.learner.loss, trainer.learner.step_targets, []

    def noted():
        seen.append(loss.actor_network_params.data.clone())
        step()

    trainer.learner.step_targets = noted
    trainer.train()
    mean = seen[0]
    for j, actor in enumerate(seen[1:6], 1):
        mean = mean.lerp(actor, torch.tensor(max(0.3, 1 / (1 + j))))
    assert len(seen) == 9
    for frozen in (seen[6], seen[8], loss.target_actor_network_params.data):
        for name, entry in frozen.items(True, True):
            torch.testing.assert_close(entry, mean[name], rtol=1e-5, atol=1e-7, msg=str(name))
    moved = [not torch.equal(seen[5][name], entry) for name, entry in seen[6].items(True, True) if name[-1] == "weight"]
    assert moved
    assert all(moved)


def test_only_an_actor_that_was_trained_comes_to_rest():
    """One that a run has got from another run is a policy of which the value is learned: it stays what it is."""
    stages = [Stage(train_actor=False), Stage(), Stage(train_actor=False), Stage(train_actor=False)]
    curriculum = Curriculum(WHOLE, 8, stages)
    assert [k for k in range(8) if curriculum.freezes(k)] == [4]


def test_targets_follow_at_an_early_rate(tmp_path):
    """With a warm-up of 4 the rates are 4/4, 4/5, 4/6 and so on, but at least polyak."""
    rates_of_targets = "learner.target_warmup=4", "learner.polyak=0.45", "learner.actor_polyak=null"
    trainer = small_trainer(tmp_path, *rates_of_targets, "trainer.updates=16")
    learner, rates = trainer.learner, []
    step = learner.step_targets

    def noted():
        rates.append(1 - learner.target_critics.eps)
        assert learner.target_actor.eps == learner.target_critics.eps
        step()

    learner.step_targets = noted
    trainer.train()
    assert rates == pytest.approx([1, 4 / 5, 4 / 6, 4 / 7, 4 / 8, 0.45, 0.45, 0.45])


def test_a_stage_with_a_rate_of_its_own_has_the_whole_decay_in_it(tmp_path):
    """From its rate down a quarter wave; the stages beside it stay on the run's course."""
    stages = "stages=[{share: 1}, {share: 2, learning_rate: 0.01}, {share: 1}]"
    trainer = small_trainer(tmp_path, stages, "trainer.updates=40", "trainer.log_every=1", "learner.learning_rate=1e-3")
    trainer.train()
    rate = read_metrics(tmp_path / "metrics.csv")["learning_rate"]

    def wave(peak, progress):
        return pytest.approx(peak * (1 + math.cos(math.pi * progress)) / 2)

    assert [rate[k] for k in (0, 9, 30)] == [wave(1e-3, k / 40) for k in (0, 9, 30)]
    assert [rate[k] for k in (10, 20, 29)] == [wave(0.01, (k - 10) / 20) for k in (10, 20, 29)]


@pytest.mark.parametrize("starts", ["faces.NearFaces", "undecided.UndecidedStates"])
def test_starts_of_a_stage_may_stand_beside_those_of_the_environment(starts, tmp_path):
    stages = f"stages=[{{share: 1, initial_states: {{_target_: pirl_rl.sampling.{starts}}}}}]"
    trainer = small_trainer(tmp_path, stages, "trainer.updates=2")
    trainer.train()
    assert type(trainer.collector.initial_states).__name__ == starts.partition(".")[2]
