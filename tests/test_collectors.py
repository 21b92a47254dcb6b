"""Collectors: what reaches the buffer, and what happens to workers."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import pytest
import torch
from small import assert_same, small_trainer
from tensordict import TensorDict

from pirl_rl.collectors.silence import Silence
from pirl_rl.collectors.transitions import TRANSITION, Exploration, Transitions
from pirl_rl.continuation import restore
from pirl_rl.errors import CollectorError
from pirl_rl.problems.reach1d_env import Reach1DEnv
from pirl_rl.trainer import Trainer

ASYNC = ("collector=multi_async", "collector.updates_per_batch=2", "collector.warmup_frames=128")


def until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


# Transitions


def two_paths() -> TensorDict:
    """Five steps of two environments; the first ends an episode at its third step. Every number tells its place."""
    place = torch.tensor([[0.0, 1, 2, 3, 4], [10, 11, 12, 13, 14]]).unsqueeze(-1)
    ended = place == 2
    here = {"tau": place, "state": place.repeat(1, 1, 2), "action": -place, "loc": 1 - place, "is_init": place == 3}
    following = {"tau": place + 0.5, "state": place.repeat(1, 1, 2) + 0.5, "reward": 2 ** (place % 10)}
    return TensorDict({**here, "next": {**following, "terminated": ended, "done": ended}}, batch_size=[2, 5])


def test_returns_stop_at_ends_of_episodes_and_of_the_batch():
    three = Transitions(3)(two_paths())
    assert three.batch_size == (10,)
    # The first path ends at step 2 and starts anew at step 3; what the batch cuts off is bootstrapped.
    ends = torch.tensor([2, 2, 2, 4, 4, 12, 13, 14, 14, 14.0]).unsqueeze(-1)
    rewards = torch.tensor([7, 6, 4, 24, 16, 7, 14, 28, 24, 16.0]).unsqueeze(-1)
    assert torch.equal(three["next", "tau"], ends + 0.5)
    assert torch.equal(three["next", "state"], (ends + 0.5).expand(-1, 2))
    assert torch.equal(three["next", "terminated"], ends == 2)
    assert torch.equal(three["next", "reward"], rewards)
    kept = two_paths().reshape(-1)
    for key in ("tau", "state", "action", "loc"):
        assert torch.equal(three[key], kept[key])


def test_one_step_returns_are_the_transitions_themselves():
    batch = two_paths()
    one = Transitions(1)(batch)
    assert set(one.keys(True, True)) == set(TRANSITION)
    assert (one == batch.select(*TRANSITION).reshape(-1)).all()
    assert (batch == two_paths()).all()


def test_random_actions_are_their_own_center():
    one = Transitions(1)(two_paths().exclude("loc"))
    assert torch.equal(one["loc"], one["action"])


def test_a_batch_may_change_from_random_actions_to_the_policy():
    batch, random = two_paths(), 2
    batch["played"], batch["next", "noise"] = batch["action"].clone(), torch.ones(2, 5, 2)
    batch["played"][:, :random] += 0.5
    batch["slope"] = torch.ones(2, 5, 2)
    one = Transitions(1)(batch).reshape(2, 5)
    assert torch.equal(one["loc"][:, :random], batch["action"][:, :random])
    assert torch.equal(one["loc"][:, random:], batch["loc"][:, random:])
    without = batch["next", "reward"] - one["next", "reward"]
    assert torch.equal(without[:, :random], torch.zeros(2, random, 1))
    assert torch.equal(without[:, random:], torch.full((2, 5 - random, 1), 2.0))


@pytest.mark.parametrize(("n_steps", "column"), [(20, 0), (20, 12), (5, 3)])
def test_returns_under_the_optimal_control_agree_with_the_exact_value(n_steps, column):
    """E[return + (1 - terminated) V(next)] = V(now): bridge and drift are exact. One transition per environment, hence
    independent samples; four standard errors."""
    env = Reach1DEnv(num_envs=20_000, seed=0)
    ahead = env.rollout(20, lambda td: td.set("action", torch.ones(20_000, 1)), break_when_any_done=False)
    batch = Transitions(n_steps)(ahead).reshape(20_000, 20)[:, column].double()
    following = batch["next"]
    terminated = following["terminated"].bool().squeeze(-1)
    assert terminated.all() == (column == 0)  # the horizon has 20 steps

    def value(td):
        return env.problem.exact_value(td["tau"].squeeze(-1), td["state"])

    error = following["reward"].squeeze(-1) + ~terminated * value(following) - value(batch)
    standard = error.std().item() / 20_000**0.5
    assert standard < 0.005
    assert error.mean().item() == pytest.approx(0, abs=4 * standard)


def test_noise_where_it_is_wanted():
    torch.manual_seed(0)
    action, first = torch.full((20_000, 2), 0.1), torch.rand(20_000, 1) < 0.5
    start, always = (Exploration(0.2, when)(action, first) for when in ("start", "always"))
    rows = first.squeeze(-1)
    assert torch.equal(start[~rows], action[~rows])
    for noisy in (start[rows], always[rows], always[~rows]):
        assert noisy.std().item() == pytest.approx(0.2, abs=5 * 0.2 / (2 * noisy.numel()) ** 0.5)
    wild = Exploration(5.0, "always")(action, first)
    assert (wild.amin().item(), wild.amax().item()) == (-1.0, 1.0)
    assert torch.equal(Exploration(0.0, "always")(action, first), action)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Exploration(-0.1, "always"), "noise >= 0.*got -0.1 and 'always'"),
        (lambda: Exploration(0.1, "never"), "'always' or 'start', got 0.1 and 'never'"),
        (lambda: Transitions(0), "collector.n_steps: expected at least 1, got 0"),
    ],
)
def test_errors_name_the_setting(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# Collectors


def test_sync_collects_at_its_pace_and_with_the_learners_actor(tmp_path):
    trainer = small_trainer(tmp_path, "collector.exploration_noise=0")
    collector, loss = trainer.collector, trainer.learner.loss
    collector.start()
    assert collector.buffer.write_count == 256
    counts = []
    for k in range(7):
        collector.step(k)
        counts.append(collector.buffer.write_count - 256)
    assert counts == [128, 128, 128, 256, 256, 256, 384]
    with torch.no_grad():
        for parameter in loss.actor_network_params.parameters():
            parameter.mul_(0.5)
    collector.step(9)
    fresh = collector.buffer[512 % 600 + 128 :][:88]
    with torch.no_grad():
        expected = loss.solution().actor(fresh["tau"], fresh["state"])
    torch.testing.assert_close(fresh["action"], expected)
    collector.close()


def test_state_of_an_empty_buffer(tmp_path):
    state = small_trainer(tmp_path).collector.state_dict()
    other = small_trainer(tmp_path)
    other.collector.load_state_dict(state)
    assert_same(other.collector.state_dict(), state)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("collector.frames_per_batch=100", "multiple of env.num_envs = 64"),
        ("collector.updates_per_batch=0", "updates_per_batch"),
        ("collector.warmup_frames=-1", "warmup_frames"),
        ("collector.buffer_size=10", "buffer_size"),
    ],
)
@pytest.mark.parametrize("kind", ["sync", "multi_async"])
def test_sizes_are_checked(kind, setting, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        small_trainer(tmp_path, f"collector={kind}", setting)


class Started:
    """Stands for TorchRL's collector, and notes the seeds that it gets."""

    procs, seeds = (), []

    def __init__(self, *args, **kwargs):
        pass

    def set_seed(self, seed: int) -> None:
        self.seeds.append(seed)

    def start(self) -> None:
        pass

    async_shutdown = start


def test_a_later_start_of_the_workers_has_other_seeds(tmp_path, monkeypatch):
    collector = small_trainer(tmp_path, "collector=multi_async", "collector.warmup_frames=1").collector
    monkeypatch.setattr("torchrl.collectors.MultiAsyncCollector", Started)
    for _ in range(2):
        collector.buffer.extend(TensorDict({"index": torch.arange(64)}, batch_size=[64]))
        collector.start()
    assert len(set(Started.seeds)) == 2


def test_a_checkpoint_keeps_its_transitions_while_workers_write(tmp_path):
    collector = small_trainer(tmp_path, *ASYNC).collector
    size = collector.buffer.storage.max_size

    def write(number: float) -> None:
        entry = torch.full((size,), number)
        collector.buffer.extend(TensorDict({"number": entry, "next": {"number": entry}}, batch_size=[size]))

    write(0.0)
    kept = collector.state_dict()["buffer"]["transitions"]
    write(1.0)
    assert (collector.buffer[:]["number"] == 1).all()
    assert (kept["number"] == 0).all()
    assert (kept["next"]["number"] == 0).all()


def assert_a_killed_worker_ends(trainer: Trainer) -> None:
    """Train, and kill a worker in the twentieth update: the training says so and leaves no process behind."""
    collector, begun = trainer.collector, trainer.update
    written = collector.buffer.write_count
    step, processes = collector.step, []

    def step_and_kill(k: int) -> None:
        step(k)
        if k == begun + 10:
            until(lambda: collector.buffer.write_count > written + 600)
        if k == begun + 20:
            processes.extend(collector._collector.procs)
            with collector._write_lock:  # which the worker then does not hold
                os.kill(processes[1].pid, signal.SIGKILL)
                until(lambda: not processes[1].is_alive())

    collector.step = step_and_kill
    with pytest.raises(CollectorError, match="worker 1 of 2 died, exit code -9"):
        trainer.train()
    assert trainer.update == begun + 21
    assert not multiprocessing.active_children()


def test_workers_feed_die_and_leave_nothing(tmp_path):
    trainer = small_trainer(tmp_path, *ASYNC, "trainer.updates=1000000", "method=pirl")
    before = [parameter.clone() for parameter in trainer.learner.loss.parameters()]
    assert_a_killed_worker_ends(trainer)
    assert any((a != b).any() for a, b in zip(before, trainer.learner.loss.parameters(), strict=True))


@pytest.mark.slow
def test_workers_go_on_after_the_run_before(tmp_path):
    small_trainer(tmp_path, *ASYNC, "trainer.updates=4", "method=pirl").train()
    assert not multiprocessing.active_children()
    trainer = small_trainer(tmp_path, *ASYNC, "trainer.updates=1000000", "method=pirl")
    restore(trainer)
    assert trainer.update == 4
    assert trainer.collector.buffer.write_count >= 128
    assert_a_killed_worker_ends(trainer)


@pytest.mark.slow
def test_a_worker_that_dies_with_the_buffer_s_lock_is_noticed(tmp_path):
    trainer = small_trainer(tmp_path, *ASYNC, "trainer.updates=1000000")
    collector = trainer.collector
    step = collector.step

    def step_and_kill(k: int) -> None:
        step(k)
        if k == 3:
            assert collector._write_lock.acquire(timeout=60)  # in the worker's place, and never released
            os.kill(collector._collector.procs[0].pid, signal.SIGKILL)
            until(lambda: not collector._collector.procs[0].is_alive())

    collector.step = step_and_kill
    with pytest.raises(CollectorError, match="worker 0 of 2 died, exit code -9"):
        trainer.train()
    assert trainer.update == 3
    assert not multiprocessing.active_children()


def test_silent_workers_are_noticed(tmp_path, monkeypatch):
    collector = small_trainer(tmp_path, *ASYNC, "collector.patience=5").collector
    collector._collector = type("Silent", (), {"procs": [multiprocessing.current_process()]})()
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    collector._silence = Silence()
    collector.step(1)
    now = 1_000.0  # the machine slept, and with it the workers
    collector.step(1)
    now = 1_001.0
    with pytest.raises(CollectorError, match="delivered nothing for 5 s"):
        collector.step(1)
    collector._collector = None
