"""Runs of a few seconds with the debug configuration: their composition, assembly and comparison."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path

import torch

from pirl_rl.assembly import make_trainer
from pirl_rl.commands.composition import compose
from pirl_rl.configuration import save_config
from pirl_rl.continuation import restore
from pirl_rl.simulator import Simulator
from pirl_rl.trainer import Trainer

# The tests below write the configuration before a trainer chooses the time steps.
STEPS = ("env.dt=0.1", "env.substeps=1")
QUICK = ("+experiment=reach1d", "+debug=default", *STEPS, "evaluation.final=[exact]", "evaluation.during=[exact]")
QUICK += ("figures=false",)
# A buffer that wraps around, and events that fall on different updates.
EVENTS = (
    *("env.num_envs=64", "collector.frames_per_batch=128", "collector.updates_per_batch=3", "collector.n_steps=1"),
    *("collector.warmup_frames=256", "collector.buffer_size=600", "collector.exploration=always"),
    *("trainer.log_every=3", "trainer.evaluate_every=4", "trainer.checkpoint_every=5"),
)

# The terms of the physics, two critics and an actor that ascends the Hamiltonian, with the constructors' sizes.
PHYSICS = ("recipe=plain", "pirl.final=[1,1,10]", "pirl.critics=2", "pirl.td_criterion=squares", "pirl.stages=[]")
PHYSICS += ("pirl.target_critics=min", "pirl.actor_rule._target_=pirl_rl.actor_rules.Hamiltonian")

TUNED = ("+experiment=reach1d", "+debug=default", *STEPS, "env.num_envs=32", "collector.frames_per_batch=64")
TUNED += ("collector.warmup_frames=64", "figures=false")
DRIFT = ("+experiment=drift", "+debug=drift", "evaluation.during=[]", "evaluation.final=[]")


composed = cache(compose)  # Hydra takes a good part of the time of a run of a few updates


def small_config(*overrides: str, base: Sequence[str] = QUICK):
    return deepcopy(composed("train", (*base, *overrides)))


def small_trainer(folder: Path, *overrides: str, base: Sequence[str] = (*QUICK, *EVENTS)) -> Trainer:
    config = small_config(*overrides, base=base)
    save_config(config, folder)
    return make_trainer(config, folder)


def resumed(folder: Path, *overrides: str) -> Trainer:
    trainer = small_trainer(folder, *overrides)
    restore(trainer)
    return trainer


def metrics(evaluator, solution, **steps) -> dict[str, float]:
    """The metrics of an evaluator under a simulator with the given dt, substeps and crossing."""
    return evaluator(solution, Simulator(solution.problem, **steps)).metrics()


def at_each_update(trainer: Trainer, action) -> None:
    """Call an action with the number of each update, from 0, just before the update."""
    step = trainer.collector.step

    def instead(k: int) -> None:
        action(k)
        step(k)

    trainer.collector.step = instead


def at_update(trainer: Trainer, update: int, action) -> None:
    """Call an action just before an update, counted from 1."""
    at_each_update(trainer, lambda k: action() if k == update - 1 else None)


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def assert_same(a, b, path: str = "state") -> None:
    """Require that two states are equal bit for bit, except for the time taken."""
    assert type(a) is type(b), path
    if isinstance(a, torch.Tensor):
        assert torch.equal(a, b), path
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), path
        for key in a.keys() - {"wall_seconds"}:
            assert_same(a[key], b[key], f"{path}.{key}")
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), path
        for index, pair in enumerate(zip(a, b, strict=True)):
            assert_same(*pair, f"{path}[{index}]")
    else:
        assert a == b, path


def command(*arguments: str, cwd: Path, module: str = "pirl_rl.train", **environment: str):
    """Run a module's command line in a new process from the directory `cwd`."""
    path = os.pathsep.join(filter(None, [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **environment}
    line = [sys.executable, "-m", module, *arguments]
    return subprocess.run(line, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


def wait_for(condition) -> None:
    """Wait until another process has made a condition true, for two minutes at most."""
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)
