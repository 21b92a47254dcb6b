"""Collectors: what reaches the buffer, and what happens to workers."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import pytest
import torch
from small import assert_same, small_trainer

from pirl_rl.assembly import restore
from pirl_rl.collectors import CollectorError

ASYNC = ("collector=multi_async", "collector.updates_per_batch=2", "collector.warmup_frames=128")


def until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


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
        expected = loss.act(fresh["tau"], fresh["state"])
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


def test_workers_feed_resume_die_and_leave_nothing(tmp_path):
    """One start of processes for all that needs them: the rest of a worker's life in its order."""
    first = small_trainer(tmp_path, *ASYNC, "trainer.updates=4", "method=pirl")
    before = [parameter.clone() for parameter in first.learner.loss.parameters()]
    first.train()
    assert any((a != b).any() for a, b in zip(before, first.learner.loss.parameters(), strict=True))
    assert not multiprocessing.active_children()

    second = small_trainer(tmp_path, *ASYNC, "trainer.updates=1000000", "method=pirl")
    restore(second)
    collector = second.collector
    written = collector.buffer.write_count
    assert written >= 128
    step, processes = collector.step, []

    def step_and_kill(k: int) -> None:
        step(k)
        if k == 10:
            until(lambda: collector.buffer.write_count > written + 600)
        if k == 20:
            processes.extend(collector._collector.procs)
            os.kill(processes[1].pid, signal.SIGKILL)
            until(lambda: not processes[1].is_alive())

    collector.step = step_and_kill
    with pytest.raises(CollectorError, match="worker 1 of 2 died, exit code -9"):
        second.train()
    assert second.update == 21
    assert not multiprocessing.active_children()


def test_silent_workers_are_noticed(tmp_path, monkeypatch):
    collector = small_trainer(tmp_path, *ASYNC, "collector.patience=5").collector
    collector._collector = type("Silent", (), {"procs": [multiprocessing.current_process()]})()
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    collector._delivered_at = now
    collector.step(1)
    now = 106.0
    with pytest.raises(CollectorError, match="delivered nothing for 5 s"):
        collector.step(1)
    collector._collector = None
