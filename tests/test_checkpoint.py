"""Checkpoints survive kills, and foreign files run nothing."""

from __future__ import annotations

import os
import pickle
import random
import signal
import subprocess
import sys
import time

import pytest
import torch
from small import resumed, small_trainer

from pirl_rl import load_run
from pirl_rl.checkpoint import load, restore_rng, save
from pirl_rl.errors import CheckpointError
from pirl_rl.files import ABANDONED, replacing
from pirl_rl.run_directory import RunDirectory

STATE = {"loss": {"weight": torch.arange(1000.0)}, "update": 3, "rng": torch.get_rng_state(), "names": ("a", 1, None)}

WRITER = """
import sys, torch
from pathlib import Path
from pirl_rl.checkpoint import save
for k in range(10_000):
    save({"loss": {"weight": torch.full((200_000,), float(k))}, "update": k}, Path(sys.argv[1]))
"""


class Payload:
    """Runs a command when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


def test_round_trip(tmp_path):
    save(STATE, tmp_path / "a" / RunDirectory.LAST.name)
    back = load(tmp_path / "a" / RunDirectory.LAST.name)
    assert torch.equal(back["loss"]["weight"], STATE["loss"]["weight"])
    assert back["names"] == STATE["names"]
    assert [path.name for path in (tmp_path / "a").iterdir()] == [RunDirectory.LAST.name]


@pytest.mark.parametrize("form", ["pickle", "torch"])
def test_hostile_pickle_runs_nothing(form, tmp_path):
    path, proof = tmp_path / RunDirectory.LAST.name, tmp_path / "ran"
    hostile = {"loss": Payload(proof), "update": 1}
    path.write_bytes(pickle.dumps(hostile)) if form == "pickle" else torch.save(hostile, path)
    with pytest.raises(CheckpointError, match=RunDirectory.LAST.name):
        load(path)
    assert not proof.exists()


def test_broken_files_are_told_as_such(tmp_path):
    save(STATE, tmp_path / RunDirectory.LAST.name)
    good = (tmp_path / RunDirectory.LAST.name).read_bytes()
    broken = tmp_path / "broken.pt"
    cuts = [0, 1, 100, len(good) // 2, len(good) - 1]
    for content in [*(good[:cut] for cut in cuts), b"\0" * 500, b"\x80\x02}q\x00."]:
        broken.write_bytes(content)
        with pytest.raises(CheckpointError, match=r"broken\.pt"):
            load(broken)
    torch.save([1, 2], broken)
    with pytest.raises(CheckpointError, match="no loss module"):
        load(broken)
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        load(tmp_path / "absent.pt")


def test_a_flipped_bit_is_noticed(tmp_path):
    """At 300 random places: the file is refused, or the bit was one of the padding between entries."""
    path, rng = tmp_path / RunDirectory.LAST.name, random.Random(0)
    save(STATE, path)
    good, noticed = path.read_bytes(), 0
    for _ in range(300):
        spoilt = bytearray(good)
        spoilt[rng.randrange(len(good))] ^= 1 << rng.randrange(8)
        path.write_bytes(spoilt)
        try:
            back = load(path)
        except CheckpointError:
            noticed += 1
        else:
            assert torch.equal(back["loss"]["weight"], STATE["loss"]["weight"])
            assert (back["update"], back["names"]) == (STATE["update"], STATE["names"])
            assert torch.equal(back["rng"], STATE["rng"])
    assert noticed > 200


def test_weights_that_are_not_finite_are_refused(tmp_path):
    trainer = small_trainer(tmp_path)
    trainer.train()
    path = tmp_path / RunDirectory.LAST
    state = load(path)
    name = next(name for name in state["learner"]["loss"] if name.startswith("actor_network_params"))
    state["learner"]["loss"][name].view(-1)[0] = float("nan")
    save(state, path)
    with pytest.raises(CheckpointError, match=rf"{name.rpartition('.')[2]}: expected finite numbers, got NaN"):
        load_run(tmp_path)
    with pytest.raises(CheckpointError, match=rf"loss\.{name}: expected finite numbers, got NaN"):
        resumed(tmp_path)


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / RunDirectory.LAST.name
    save(STATE, path)
    before = path.read_bytes()
    with pytest.raises(AttributeError, match="pickle"):
        save({"half": torch.ones(1000), "rest": lambda: None}, path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [RunDirectory.LAST.name]


def test_a_link_under_the_drafts_name_is_not_followed(tmp_path, monkeypatch):
    monkeypatch.setattr("pirl_rl.files.secrets.token_hex", lambda count: "known")
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / f".{RunDirectory.LAST.name}.known.draft").symlink_to(precious)
    with pytest.raises(FileExistsError):
        save(STATE, tmp_path / RunDirectory.LAST.name)
    assert precious.read_text() == "mine"


def test_two_writers_of_one_file_do_not_meet(tmp_path):
    path = tmp_path / "table.md"
    with replacing(path) as one:
        one.write("first half, ")
        with replacing(path) as other:
            other.write("other")
        assert path.read_text() == "other"
        one.write("second half")
    assert path.read_text() == "first half, second half"
    assert [entry.name for entry in tmp_path.iterdir()] == ["table.md"]


def test_drafts_of_writers_that_were_killed_are_removed(tmp_path):
    path, old, young = (tmp_path / name for name in ("table.md", ".table.md.1.draft", ".table.md.2.draft"))
    for draft, age in ((old, 2 * ABANDONED), (young, 1)):
        draft.touch()
        os.utime(draft, (time.time() - age,) * 2)
    with replacing(path) as file:
        file.write("whole")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [young.name, path.name]


def test_generators_go_on_and_another_device_s_begins_anew():
    one, other, another = (torch.Generator().manual_seed(seed) for seed in (1, 2, 3))
    restore_rng(other, one.get_state())
    assert torch.equal(torch.rand(3, generator=other), torch.rand(3, generator=one))
    draws = []
    for state in (torch.zeros(16, dtype=torch.uint8), torch.ones(16, dtype=torch.uint8)):  # as CUDA's
        restore_rng(another, state)
        draws.append(torch.rand(3, generator=another))
    assert not torch.equal(*draws)


def test_every_checkpoint_of_a_killed_writer_loads(tmp_path):
    path = tmp_path / RunDirectory.LAST.name
    save({"loss": {"weight": torch.zeros(1)}, "update": -1}, path)
    rng = random.Random(0)
    for _ in range(3):
        child = subprocess.Popen([sys.executable, "-c", WRITER, str(path)])
        first = path.stat().st_mtime_ns
        while path.stat().st_mtime_ns == first:
            assert child.poll() is None, "the writer ended before its first checkpoint"
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.05))
        child.kill()
        child.wait()
        state = load(path)
        assert (state["loss"]["weight"] == state["update"]).all()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    small_trainer(folder, "trainer.updates=5").train()
    return folder


def test_weights_are_files_of_the_run(run, tmp_path):
    assert load_run(run).update == 5
    save({"loss": {}, "update": 1}, tmp_path / "elsewhere.pt")
    for weights in ("../../elsewhere.pt", str(tmp_path / "elsewhere.pt")):
        with pytest.raises(CheckpointError, match="weights"):
            load_run(run, weights=weights)
    save({"loss": {"x": torch.ones(1)}, "update": 1}, run / "checkpoints" / "other.pt")
    with pytest.raises(CheckpointError, match="does not fit"):
        load_run(run, weights="other.pt")


@pytest.mark.slow
def test_killed_training_at_twenty_random_moments(tmp_path):
    """Every checkpoint left behind loads, and training continues from it until the next kill."""
    rng, folder = random.Random(1), tmp_path / "run"
    small_trainer(folder, "trainer.updates=1000000", "trainer.checkpoint_every=2", "evaluation.during=[]").save()
    reached = 0
    for _ in range(20):
        child = subprocess.Popen(
            [sys.executable, "-m", "pirl_rl.train", f"resume={folder}"],
            cwd=os.path.dirname(os.path.dirname(__file__)),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        while load(folder / RunDirectory.LAST)["update"] == reached:
            assert child.poll() is None, "training ended by itself"
            time.sleep(0.02)
        time.sleep(rng.uniform(0, 1))
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        for path in (folder / "checkpoints").glob("*.pt"):
            load(path)
        reached = load(folder / RunDirectory.LAST)["update"]
    assert resumed(folder, "trainer.updates=1000000").update == reached >= 40
