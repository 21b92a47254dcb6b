"""New runs that start with the networks of another run."""

from __future__ import annotations

import copy

import pytest
import torch
from small import QUICK, assert_same, at_update, interrupt, resumed, small_trainer
from test_checkpoint import Payload

from pirl_rl import checkpoint, train
from pirl_rl.checkpoint import load
from pirl_rl.collectors.transitions import TRANSITION
from pirl_rl.configuration import load_config
from pirl_rl.continuation import start_from
from pirl_rl.errors import CheckpointError, Interrupted
from pirl_rl.run_directory import RunDirectory
from pirl_rl.trainer import Trainer

NOISELESS = ("collector.exploration_noise=0", "collector.exploration=always")


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A run of 20 updates with weights kept at the fifth, and what its end left."""
    folder = tmp_path_factory.mktemp("first")
    small_trainer(folder, *NOISELESS).train()
    return folder, load(folder / RunDirectory.LAST)


def begun(folder, start, *overrides: str) -> Trainer:
    trainer = small_trainer(folder, *NOISELESS, *overrides)
    start_from(trainer, str(start))
    return trainer


def transitions(state: dict, cursor: int = 0) -> dict[tuple | str, torch.Tensor]:
    """The transitions of a buffer's state, from the oldest to the newest."""
    parts = state["transitions"]
    flat = {key: parts["next"][key[1]] if isinstance(key, tuple) else parts[key] for key in TRANSITION}
    return {key: entry.roll(-cursor, 0) for key, entry in flat.items()}


def played_by_the_actor(trainer: Trainer, first: int) -> bool:
    """Whether the actions of a buffer from an index on are those of the noise-free actor."""
    batch = trainer.collector.buffer[first:]
    with torch.no_grad():
        action = trainer.solution.actor(batch["tau"], batch["state"])
    return len(batch) > 0 and torch.allclose(batch["action"], action, atol=1e-6)


def test_last_brings_networks_optimisers_and_transitions(first, tmp_path):
    folder, left = first
    trainer = begun(tmp_path, folder, "seed=7", "trainer.updates=5")
    assert trainer.update == 0
    assert_same(trainer.learner.state_dict(), left["learner"])
    buffer = left["collector"]["buffer"]
    cursor = buffer["writer"]["_cursor"]
    assert 0 < cursor < 600  # it was written around its end
    mine = trainer.collector.state_dict()["buffer"]
    assert_same(transitions(mine), transitions(buffer, cursor))
    assert not torch.equal(trainer.batches.rng.get_state(), left["rng"])
    trainer.collector.start()
    assert trainer.collector.buffer.write_count == 600  # no warm-up
    trainer.collector.step(0)
    assert played_by_the_actor(trainer, 0) is False
    assert trainer.train()["updates"] == 5


def test_runs_from_one_checkpoint_have_their_own_seeds(first, tmp_path):
    def end(name: str, seed: int) -> dict:
        trainer = begun(tmp_path / name, first[0], f"seed={seed}", "trainer.updates=3")
        trainer.train()
        return trainer.learner.state_dict()

    same, again, other = end("a", 1), end("b", 1), end("c", 2)
    assert_same(same, again)
    with pytest.raises(AssertionError):
        assert_same(same, other)


def test_weights_bring_networks_and_the_actor_plays_the_warm_up(first, tmp_path):
    [weights, *_] = sorted((first[0] / "checkpoints").glob("weights-*.pt"))
    trainer = begun(tmp_path, weights, "seed=7")
    assert_same(dict(trainer.learner.loss.state_dict()), dict(load(weights)["loss"]))
    assert not any(one.state_dict()["state"] for one in trainer.learner.critic_optimizers)
    trainer.collector.start()
    assert trainer.collector.buffer.write_count == 256
    assert played_by_the_actor(trainer, 0)
    fresh = small_trainer(tmp_path / "fresh", *NOISELESS)
    fresh.collector.start()
    assert not played_by_the_actor(fresh, 0)


def test_exported_weights_stand_for_the_targets_too(first, tmp_path):
    loss = {name: entry for name, entry in first[1]["learner"]["loss"].items() if not name.startswith("target_")}
    checkpoint.save({"loss": loss, "update": 20}, tmp_path / "run" / "checkpoints" / "weights-000000020.pt")
    trainer = begun(tmp_path / "new", tmp_path / "run")
    state = trainer.learner.loss.state_dict()
    for name, entry in loss.items():
        assert torch.equal(state[name], entry)
        if f"target_{name}" in state:
            assert torch.equal(state[f"target_{name}"], entry)


@pytest.mark.parametrize(("size", "warmup"), [(300, 256), (2_000, 700)])
def test_another_size_of_buffer(size, warmup, first, tmp_path):
    """A smaller one takes the newest; where the warm-up wants more, the actor plays the rest."""
    sizes = (f"collector.buffer_size={size}", f"collector.warmup_frames={warmup}")
    trainer = begun(tmp_path, first[0], *sizes)
    buffer = first[1]["collector"]["buffer"]
    expected = transitions(buffer, buffer["writer"]["_cursor"])
    kept = min(size, 600)
    mine = transitions(trainer.collector.state_dict()["buffer"])
    assert_same(mine, {key: entry[-kept:] for key, entry in expected.items()})
    trainer.collector.start()
    assert len(trainer.collector.buffer) == (300 if size == 300 else 600 + 128)
    assert size == 300 or played_by_the_actor(trainer, 600)


@pytest.mark.slow
def test_workers_play_the_actor_in_the_warm_up(first, tmp_path):
    [weights, *_] = sorted((first[0] / "checkpoints").glob("weights-*.pt"))
    asynchronous = ("collector=multi_async", *NOISELESS, "collector.n_steps=1")
    for name, start, actor_played in (("weights", weights, True), ("last", first[0], False)):
        trainer = begun(tmp_path / name, start, *asynchronous)
        trainer.collector.start()
        trainer.collector.close()
        assert played_by_the_actor(trainer, 0) == actor_played  # the transitions of `last` are of earlier actors
        assert trainer.collector.buffer.write_count >= 256


def test_a_collapsed_runs_transitions_stay_behind(first, tmp_path):
    collapsed = {**first[1], "rollback": {"collapsed_at": 18}}
    checkpoint.save(collapsed, tmp_path / "run" / RunDirectory.LAST)
    trainer = begun(tmp_path / "new", tmp_path / "run")
    assert_same(trainer.learner.state_dict(), first[1]["learner"])
    trainer.collector.start()
    assert len(trainer.collector.buffer) == 256
    assert played_by_the_actor(trainer, 0)


@pytest.mark.parametrize("kind", [RunDirectory.LAST.name, "weights-000000005.pt"])
def test_such_a_run_resumes_bit_for_bit_without_its_start(kind, first, tmp_path):
    source = tmp_path / "source.pt"
    source.write_bytes((first[0] / "checkpoints" / kind).read_bytes())
    short = ("collector.warmup_frames=200", "collector.exploration_noise=0.1", "seed=3")
    whole = begun(tmp_path / "whole", source, *short)
    whole.train()
    cut = begun(tmp_path / "cut", source, *short)
    source.unlink()
    at_update(cut, 7, interrupt)
    with pytest.raises(Interrupted):
        cut.train()
    resumed(tmp_path / "cut", *NOISELESS, *short).train()
    ends = [load(tmp_path / name / RunDirectory.LAST) for name in ("cut", "whole")]
    assert_same(*ends)
    rows = [(tmp_path / name / "metrics.csv").read_bytes() for name in ("cut", "whole")]
    assert rows[0] == rows[1]


def test_transitions_of_another_environment_are_refused(first, tmp_path):
    parts = first[1]["collector"]["buffer"]["transitions"]
    other = {**parts, "state": parts["state"].repeat(1, 2)}
    left = first[1]["collector"]
    foreign = {**first[1], "collector": {**left, "buffer": {**left["buffer"], "transitions": other}}}
    checkpoint.save(foreign, tmp_path / RunDirectory.LAST.name)
    with pytest.raises(CheckpointError, match=r"does not fit.*state: expected shape \(1,\), got \(2,\)"):
        begun(tmp_path / "new", tmp_path / RunDirectory.LAST.name)


# The command


@pytest.fixture
def cli(in_process):
    return in_process(train)


@pytest.mark.parametrize(("part", "key"), [("learner", "actor_rule"), ("transitions", "loc")])
def test_a_checkpoint_that_lacks_an_entry_says_which(part, key, first, tmp_path):
    _folder, left = first
    state = copy.deepcopy(left)
    del (state["learner"] if part == "learner" else state["collector"]["buffer"]["transitions"])[key]
    checkpoint.save(state, path := tmp_path / "older" / RunDirectory.LAST.name)
    with pytest.raises(CheckpointError, match=f"does not fit.*no entry .*{key}.*weights-"):
        begun(tmp_path / "new", path)


def test_the_command_starts_from_a_run(first, cli, tmp_path):
    """A relative path is recorded as the file it was, so that the record holds from any directory."""
    (tmp_path / "link").symlink_to(first[0])
    code, text = cli(*QUICK, "trainer.updates=3", "start=link", "env.num_envs=64", "collector.frames_per_batch=128")
    assert code == 0, text
    [run] = tmp_path.glob("runs/*/*")
    assert load_config(run).start == str(tmp_path / "link" / RunDirectory.LAST)


def test_a_relative_start_is_that_of_the_directory_where_the_command_was_given(first, cli, tmp_path):
    """Hydra changes to the run directory first, where it is told to."""
    (tmp_path / "link").symlink_to(first[0])
    few = ("trainer.updates=3", "env.num_envs=64", "collector.frames_per_batch=128", "report=false")
    code, text = cli(*QUICK, *few, "start=link", "hydra.job.chdir=true", "hydra.run.dir=run")
    assert code == 0, text
    assert load_config(tmp_path / "run").start == str(tmp_path / "link" / RunDirectory.LAST)


def test_the_networks_have_the_settings_of_the_run_from_which_they_are(cli, tmp_path):
    """A setting that is typed stands."""
    other = tmp_path / "other"
    small_trainer(other, *NOISELESS, "critic.log_levels=false", "actor.hidden=[16]", "actor.spread=2.0").train()
    few = ("trainer.updates=3", f"start={other}", "env.num_envs=64", "collector.frames_per_batch=128")
    code, text = cli(*QUICK, "actor.spread=4.0", *few)
    assert code == 0, text
    [run] = tmp_path.glob("runs/*/*")
    here, there = load_config(run), load_config(other)
    assert here.critic == there.critic
    assert there.actor.choices == "auto"  # the helper of the tests records what it was given
    assert here.actor == {
        **there.actor,
        "spread": 4.0,
        "choices": None,
        "together": 1,
        "window": 0.0,
        "log_levels": False,
    }


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["start=nowhere"], "no checkpoint at nowhere"),
        (["start=."], "no checkpoint at checkpoints/last.pt"),
        (["start=broken.pt"], "broken.pt is not a checkpoint"),
        (["start=hostile.pt"], "hostile.pt is not a checkpoint"),
        (["start=spoilt.pt"], "expected finite numbers, got NaN"),
        (["start=3"], "start: expected the path of a run or a checkpoint, got 3"),
        (["start=[a]"], "start: expected the path"),
        (["start=FIRST", "critic.hidden=[8]"], "does not fit the run's configuration"),
        (["start=FIRST", "critics=2"], "does not fit the run's configuration"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistakes_are_named_and_leave_nothing(arguments, told, first, cli, tmp_path):
    (tmp_path / "broken.pt").write_bytes(b"\0" * 100)
    torch.save({"loss": Payload(tmp_path / "ran"), "update": 1}, tmp_path / "hostile.pt")
    spoilt = {name: entry * torch.nan for name, entry in first[1]["learner"]["loss"].items()}
    torch.save({"loss": spoilt, "update": 1}, tmp_path / "spoilt.pt")
    code, text = cli(*QUICK, *(item.replace("FIRST", str(first[0])) for item in arguments))
    assert code == 1
    assert told in text
    assert "Traceback" not in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.pt", "hostile.pt", "spoilt.pt"]


def test_a_run_that_goes_on_has_no_other_start(first, cli):
    code, text = cli(f"resume={first[0]}", f"start={first[0]}")
    assert code == 1
    assert "the run has begun already" in text
