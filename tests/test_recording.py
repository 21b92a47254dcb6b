"""Training whose work is recorded and replayed, as on a GPU, with recordings that the CPU emulates.

An emulated recording notes all operations on tensors, and a replay repeats them on the same memory. It refuses what a
graph of CUDA kernels refuses: numbers that come back from the device, sizes that depend on data, and new numbers.
"""

from __future__ import annotations

import pytest
import torch
from small import DRIFT, EVENTS, PHYSICS, QUICK, STEPS, at_update, resumed, small_trainer
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from pirl_rl import recording
from pirl_rl.collectors.joint import JointPlayer
from pirl_rl.constants import constant
from pirl_rl.errors import DivergenceError
from pirl_rl.population import Population
from pirl_rl.recording import Recorded
from pirl_rl.sampling.supply import Stock
from pirl_rl.trainer import Trainer

aten = torch.ops.aten
REFUSED = {aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default, aten.equal.default}
REFUSED |= {aten.lift_fresh.default, aten.is_nonzero.default}


def tensors(tree) -> list[torch.Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


def memory(entry: torch.Tensor) -> int | None:
    """Where the entries of a tensor are; the zeros of forward mode are nowhere."""
    return None if entry._is_zerotensor() else entry.untyped_storage().data_ptr()


class Tape(TorchDispatchMode):
    def __init__(self, name: str):
        super().__init__()
        self.name = name
        self.operations: list = []
        self.played = True  # the emulation does what it notes, where a recording of CUDA kernels only notes it

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        by_mask = "index" in func.__name__ and any(entry.dtype == torch.bool for entry in tensors(args[1:2]))
        if func in REFUSED or by_mask:
            raise RuntimeError(f"{func} asks something of the device")
        result = func(*args, **(kwargs or {}))
        known = {memory(entry) for entry in tensors((args, kwargs))}
        new = [memory(entry) not in {*known, None} for entry in tensors(result)]
        self.operations.append((func, args, kwargs or {}, tensors(result), new))
        return result

    def replay(self) -> None:
        if self.played:
            self.played = False
            return
        with torch.no_grad():
            for func, args, kwargs, results, new in self.operations:
                again = tensors(func(*args, **kwargs))
                for result, other, own in zip(results, again, new, strict=True):
                    if own:
                        result.detach().copy_(other)


def emulated(self: Recorded) -> None:
    self._graph = Tape(self.name)
    with self._graph:
        self._result = self.work()


def direct(self: Recorded) -> None:
    """Record nothing, so that all calls do the work."""


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    monkeypatch.setattr(recording, "records", lambda device: True)


def networks(*trainers: Trainer) -> list[dict[str, torch.Tensor]]:
    return [{name: entry.clone() for name, entry in one.learner.loss.state_dict().items()} for one in trainers]


BASES = {"default": QUICK + EVENTS, "physics": QUICK + EVENTS + PHYSICS, "drift": DRIFT}
BASES["muon"] = (*QUICK, *EVENTS, "learner.optimizer=muon", "learner.target_warmup=3", "actor.hidden=[16,16,16]")


def assert_replays_do_what_the_work_does(monkeypatch, folder, updates: int, members: int, base) -> None:
    found = []
    for how in (direct, emulated):
        monkeypatch.setattr(Recorded, "_record", how)
        changes, own = ("compile=false", f"trainer.updates={updates}"), folder / how.__name__
        trainers = [small_trainer(own / str(seed), *changes, f"seed={seed}", base=base) for seed in range(members)]
        trainers[0].train() if members == 1 else Population(trainers, [{} for _ in trainers]).train()
        found.append(networks(*trainers))
    torch.testing.assert_close(*found, rtol=0, atol=0)


@pytest.mark.parametrize("members", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("base", BASES.values(), ids=BASES)
def test_replays_do_what_the_work_does(as_on_a_gpu, monkeypatch, base, members, tmp_path):
    assert_replays_do_what_the_work_does(monkeypatch, tmp_path, 12, members, base)


SHIPPED = ("dubins", "zermelo", "pendulum", "cartpole", "quadrotor", "halfspace", "radial_exit", "drift3")
RECORDED_BY_DEFAULT = ("zermelo",)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in RECORDED_BY_DEFAULT)) for name in SHIPPED]
)
def test_the_shipped_problems_can_be_recorded(as_on_a_gpu, monkeypatch, name, tmp_path):
    """With all terms of the loss, so that drift, diffusion and levels are computed."""
    small = ("env.num_envs=16", "collector.frames_per_batch=32", "collector.warmup_frames=32")
    small += (
        "collector.buffer_size=32",
        "collector.updates_per_batch=2",
        "collector.n_steps=1",
        "trainer.batch_size=8",
    )
    terms = ("pirl.final=[1,1,10]", "loss.hjb_probes=0", "evaluation.final=[]", "evaluation.during=[]")
    base = (
        f"+experiment={name}",
        "+debug=default",
        *STEPS,
        *small,
        *terms,
        "trainer.evaluate_every=0",
        "figures=false",
    )
    assert_replays_do_what_the_work_does(monkeypatch, tmp_path, 5, 1, base)


def test_most_updates_are_replayed(as_on_a_gpu, monkeypatch, tmp_path):
    """Those with and without an actor's are done directly once for each of the four sizes of the replay buffer."""
    monkeypatch.setattr(Recorded, "_record", emulated)
    replays = []
    monkeypatch.setattr(Tape, "replay", lambda self, replay=Tape.replay: (replays.append(self.name), replay(self)))
    small_trainer(tmp_path, "compile=false", "trainer.updates=40").train()
    assert replays.count("an update") == 40 - 2 * 4


def test_a_run_goes_on_where_nothing_is_recorded_and_back(monkeypatch, tmp_path):
    monkeypatch.setattr(Recorded, "_record", emulated)
    monkeypatch.setattr(recording, "records", lambda device: True)
    small_trainer(tmp_path, "compile=false", "trainer.updates=4").train()
    for records, updates in ((False, 8), (True, 12)):
        monkeypatch.setattr(recording, "records", lambda device, records=records: records)
        trainer = resumed(tmp_path, "compile=false", f"trainer.updates={updates}")
        trainer.train()
        assert trainer.update == updates


class Refusing(TorchDispatchMode):
    """Fails in the midst of what it sees, as a recording of a problem that copies numbers to the device does."""

    def __init__(self):
        super().__init__()
        self.left = 40

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("no number goes to the device")
        return func(*args, **(kwargs or {}))


def test_training_goes_on_where_recordings_fail(as_on_a_gpu, monkeypatch, tmp_path):
    failed = []

    def fails(self: Recorded) -> None:
        with pytest.raises(RuntimeError, match="no number"), Refusing():
            self.work()
        failed.append(self.name)

    monkeypatch.setattr(Recorded, "_record", fails)
    trainer = small_trainer(tmp_path, "compile=false", "trainer.updates=12")
    trainer.train()
    assert trainer.update == 12
    assert {*failed} == {"an update", "playing"}


def test_a_divergence_is_found_at_the_next_row(as_on_a_gpu, monkeypatch, tmp_path):
    monkeypatch.setattr(Recorded, "_record", emulated)
    trainer = small_trainer(tmp_path, "compile=false", "trainer.updates=40", "trainer.log_every=3")

    def spoil() -> None:
        next(trainer.learner.loss.qvalue_network_params.parameters()).data.fill_(torch.nan)

    at_update(trainer, 20, spoil)
    with pytest.raises(DivergenceError, match="update 20: a loss is not finite"):
        trainer.train()


def test_members_play_their_own_policies(as_on_a_gpu, monkeypatch, tmp_path):
    monkeypatch.setattr(Recorded, "_record", emulated)
    trainers = [small_trainer(tmp_path / str(i), "compile=false", f"seed={i}") for i in range(3)]
    collectors = [trainer.collector for trainer in trainers]
    for trainer in trainers:
        trainer.collector.warm_start(None)
    joint = JointPlayer(collectors)
    for _ in range(4):
        parts = [joint.part(index) for index in range(3)]
        for collector, part in zip(collectors, parts, strict=True):
            assert len(part) == collector.frames_per_batch
            expected = collector.policy.actor(part["tau"], part["state"])
            torch.testing.assert_close(part["loc"], expected.detach(), rtol=1e-4, atol=1e-5)
    assert not torch.equal(parts[0]["state"], parts[1]["state"])
    joint.close()


def numbered(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.arange(count), torch.arange(count, dtype=torch.float32).unsqueeze(-1)


def test_a_stock_gives_its_states_in_turn_to_the_paths_that_have_ended():
    """Two queues of three paths each; after eight steps with two states for each path a queue has six."""
    stock = Stock(groups=2)
    stock.fill(8, 6, numbered)
    steps, states = stock.take(torch.tensor([True, False, True, False, True, False]), numbered)
    assert steps[[0, 2, 4]].tolist() == states[[0, 2, 4], 0].tolist() == [0, 1, 6]
    steps, _ = stock.take(torch.ones(6, dtype=torch.bool), numbered)
    assert steps.tolist() == [2, 3, 4, 7, 8, 9]
    steps, _ = stock.take(torch.ones(6, dtype=torch.bool), numbered)
    assert steps.tolist() == [5, 0, 1, 10, 11, 6]  # each queue begins anew


def test_a_stock_is_drawn_again_after_its_steps():
    stock, draws = Stock(), []

    def draw(count: int):
        draws.append(count)
        return numbered(count)

    stock.fill(4, 5, draw)
    for _ in range(6):
        stock.take(torch.ones(5, dtype=torch.bool), draw)
    assert draws == [5, 5, 5]


def test_numbers_become_a_tensor_once_for_each_dtype():
    x, y = torch.zeros(3), torch.zeros(3, dtype=torch.float64)
    assert constant((0.1, 2), x) is constant([0.1, 2.0], x)
    assert constant((0.1, 2), y).dtype == torch.float64
    torch.testing.assert_close(constant([[0.1, 2.0], [3.0, 4.0]], y), torch.tensor([[0.1, 2], [3, 4]]).to(y))
    mapped = torch.func.vmap(torch.func.functionalize(lambda z: z * constant((0.5, 0.9), z)))(torch.ones(2, 2))
    torch.testing.assert_close(mapped, torch.tensor([[0.5, 0.9], [0.5, 0.9]]))
    torch.testing.assert_close(constant((0.5, 0.9), x).clone(), torch.tensor([0.5, 0.9]))
    with torch.inference_mode():
        constant((0.2, 0.4), x)
    (torch.ones(2, requires_grad=True) * constant((0.2, 0.4), x)).sum().backward()
    compiled = torch.compile(lambda z: z * constant((0.3, 0.7), z), backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(torch.ones(2)), torch.tensor([0.3, 0.7]))
