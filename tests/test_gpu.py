"""A CUDA device against the CPU: physics, losses, training, and runs that change the device."""

from __future__ import annotations

import warnings

import pytest
import torch
from small import DRIFT, EVENTS, PHYSICS, QUICK, command, resumed, small_config, small_trainer

from pirl_rl.assembly import make_trainer
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.population import Population
from pirl_rl.problems import Reach1D, VehicleDrift
from pirl_rl.recording import Recorded
from pirl_rl.runs.load import load_run

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


@pytest.mark.parametrize("problem", [Reach1D(), VehicleDrift()], ids=["reach1d", "drift"])
def test_the_physics_is_the_same(problem):
    """In float64, so that only the order of sums differs."""
    rng = torch.Generator().manual_seed(0)
    x = problem.states.sample(1_000, rng, torch.float64)
    u = problem.controls.sample(1_000, rng, torch.float64)
    for name in ("drift", "diffusion"):
        expected, got = getattr(problem, name)(x, u), getattr(problem, name)(x.cuda(), u.cuda())
        torch.testing.assert_close(got.cpu(), expected, rtol=1e-9, atol=1e-9)
    for name in ("target_level", "boundary_value", "unreachable"):
        torch.testing.assert_close(getattr(problem, name)(x.cuda()).cpu(), getattr(problem, name)(x))


def test_success_probabilities_are_the_exact_ones():
    """10,000 paths a state: four standard errors are 0.02."""
    problem = Reach1D()
    x = torch.linspace(-1, 1, 9, device="cuda").unsqueeze(-1)
    tau = torch.full((9,), problem.horizon, device="cuda")
    estimate = monte_carlo(problem, problem.optimal_control, tau, x, rollouts=10_000)
    assert estimate.probability.is_cuda
    torch.testing.assert_close(estimate.probability, problem.exact_value(tau, x), rtol=0, atol=0.02)


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "compiled"])
@pytest.mark.parametrize("base", [QUICK + EVENTS, DRIFT], ids=["reach1d", "drift"])
def test_training_and_its_run_on_a_machine_without(base, compiled, tmp_path):
    changes = ("device=cuda", f"compile={compiled}", "trainer.updates=6")
    trainer = small_trainer(tmp_path / "run", *changes, base=base)
    before = [parameter.detach().clone() for parameter in trainer.learner.loss.parameters()]
    assert all(parameter.is_cuda for parameter in before)
    trainer.train()
    assert any((a != b).any() for a, b in zip(before, trainer.learner.loss.parameters(), strict=True))
    here, there = (load_run(tmp_path / "run", device=device) for device in ("cpu", "cuda"))
    x = here.problem.states.sample(200, torch.Generator().manual_seed(2))
    for name in ("value", "policy"):
        torch.testing.assert_close(
            getattr(there, name)(1.0, x.cuda()).cpu(), getattr(here, name)(1.0, x), rtol=1e-3, atol=1e-4
        )


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "compiled"])
@pytest.mark.parametrize("base", [QUICK + EVENTS, QUICK + EVENTS + PHYSICS, DRIFT], ids=["default", "physics", "drift"])
def test_replays_do_what_the_work_does(base, compiled, tmp_path, monkeypatch):
    found = []
    for name, record in (("recorded", Recorded._record), ("direct", lambda self: None)):
        monkeypatch.setattr(Recorded, "_record", record)
        changes = ("device=cuda", f"compile={compiled}", "trainer.updates=12")
        trainer = small_trainer(tmp_path / name, *changes, base=base)
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*without a graph")
            trainer.train()
        found.append(trainer.learner.loss.state_dict())
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-5)


def test_a_population_replays_what_it_does(tmp_path, monkeypatch):
    found = []
    for name, record in (("recorded", Recorded._record), ("direct", lambda self: None)):
        monkeypatch.setattr(Recorded, "_record", record)
        changes = ("device=cuda", "compile=true", "trainer.updates=12")
        members = [small_trainer(tmp_path / name / str(seed), *changes, f"seed={seed}") for seed in range(3)]
        Population(members, [{} for _ in members]).train()
        found.append([member.learner.loss.state_dict() for member in members])
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-5)


class Copying(Reach1D):
    """Numbers are copied to the device at each call, which a recording cannot contain."""

    def target_level(self, x):
        return super().target_level(x) * torch.tensor(1.0).to(x.device)


def test_a_problem_that_cannot_be_recorded_trains_with_a_warning(tmp_path):
    config = small_config("device=cuda", "compile=false", "trainer.updates=6", base=QUICK + EVENTS)
    trainer = make_trainer(config, tmp_path, problem=Copying())
    with pytest.warns(UserWarning, match="playing runs without a graph of kernels"):
        trainer.train()
    assert trainer.update == 6


def test_a_run_goes_on_elsewhere(tmp_path):
    small_trainer(tmp_path, "device=cuda", "trainer.updates=4").train()
    for device, updates in (("cpu", 6), ("cuda", 8)):
        trainer = resumed(tmp_path, f"device={device}", f"trainer.updates={updates}")
        trainer.train()
        assert trainer.update == updates


def test_workers_play_on_the_cpu_for_a_learner_on_the_device(tmp_path):
    asynchronous = ("collector=multi_async", "collector.updates_per_batch=2", "collector.warmup_frames=128")
    trainer = small_trainer(tmp_path, *asynchronous, "device=cuda", "trainer.updates=6")
    trainer.train()
    assert trainer.update == 6


def test_commands(tmp_path):
    quick = ("+experiment=reach1d", "+debug=default", "device=cuda", "hydra.run.dir=run")
    done = command(*quick, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = command("run=run", "device=cuda", cwd=tmp_path, module="pirl_rl.evaluate")
    assert done.returncode == 0, done.stderr
