"""Where the time of a training goes: the share of each part of real updates, without and with the physics.

    python benchmarks/training_profile.py [--experiments reach1d quadrotor] [--updates 300] [--json FILE] [key=value]
    python benchmarks/training_profile.py --experiments own env.problem._target_=benchmarks.kinds.FastCharge

Each experiment is trained with the default recipe and `key=value` settings for `--updates` updates after a first
hundred, in which everything is compiled. Times are those of one call without the calls inside it, so that the rows add
up to the whole loop; evaluations, checkpoints and the losses of the physics are measured by themselves.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from benchmarks.record import save
from pirl_rl.assembly import make_trainer
from pirl_rl.collectors.sync import SyncCollector
from pirl_rl.commands.composition import compose
from pirl_rl.commands.console import named_modules
from pirl_rl.evaluation import evaluate
from pirl_rl.trainer import Trainer

WARM_UP = 100
"""The number of updates before the clock runs, in which everything is compiled."""

PHYSICS = ("schedule.initial=[1,1,1]", "schedule.final=[1,1,1]")
"""Settings with which an update has all three losses."""


class Clock:
    """Adds up the time of named parts, each without the parts inside it."""

    def __init__(self):
        self.seconds: dict[str, float] = defaultdict(float)
        self._inside: list[float] = []

    @contextmanager
    def part(self, name: str):
        self._inside.append(0.0)
        started = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - started
            self.seconds[name] += elapsed - self._inside.pop()
            if self._inside:
                self._inside[-1] += elapsed

    def watch(self, owner: Any, method: str, name: str) -> None:
        """Count the calls of a method of one object as a part."""
        function: Callable = getattr(owner, method)

        def counted(*args: Any, **kwargs: Any) -> Any:
            with self.part(name):
                return function(*args, **kwargs)

        object.__setattr__(owner, method, counted)


def watch(trainer: Trainer, clock: Clock) -> None:
    """Count the parts of the loop of a trainer."""
    learner, collector = trainer.learner, trainer.collector
    assert isinstance(collector, SyncCollector)
    clock.watch(collector, "step", "collector: resets, stacking, the rest")
    clock.watch(collector.env.simulator, "step", "collector: simulation")
    clock.watch(collector.env.simulator, "_draw", "collector: random numbers")
    clock.watch(collector.env, "_step", "collector: environment around the simulation")
    clock.watch(collector._player.policy, "forward", "collector: policy and control variate")
    clock.watch(collector._player, "transitions", "collector: returns")
    clock.watch(collector.buffer, "extend", "collector: buffer")
    clock.watch(trainer.batches, "sample", "sampling of the batch")
    clock.watch(learner, "update", "update: the rest")
    clock.watch(learner.gradients, "critic", "update: critic loss and gradient")
    clock.watch(learner.gradients, "actor", "update: actor loss and gradient")
    clock.watch(learner, "step_targets", "update: target networks")
    for name in ("critic", "actor"):
        for optimizer in getattr(learner, f"{name}_optimizers"):
            clock.watch(optimizer, "step", f"update: optimiser of the {name}, {type(optimizer).__name__}")


def loop(trainer: Trainer, updates: int) -> None:
    """The updates of `Trainer._loop`, without logs, evaluations and checkpoints."""
    for k in range(trainer.update, trainer.update + updates):
        trainer.collector.step(k)
        weights = trainer.curriculum.weights(k)
        batch = trainer.batches.sample(weights, trainer.curriculum.progress(k))
        trainer.learner.update(batch, k, weights, trainer.curriculum.decay(k))
    trainer.update += updates


def measure(experiment: str, settings: list[str], updates: int) -> dict[str, Any]:
    started = time.perf_counter()
    config = compose("train", [f"+experiment={experiment}", "device=cpu", "logger=none", *settings])
    trainer = make_trainer(config, trust=named_modules(settings))
    trainer._enter_stage()
    trainer.collector.start()
    loop(trainer, 1)
    first = time.perf_counter() - started
    loop(trainer, WARM_UP - 1)
    clock = Clock()
    watch(trainer, clock)
    started = time.perf_counter()
    with clock.part("loop"):
        loop(trainer, updates)
    whole = time.perf_counter() - started
    started = time.perf_counter()
    if trainer.evaluate_every:
        evaluate(trainer.solution, trainer.simulator, trainer.during)
    evaluation = time.perf_counter() - started
    return {
        "experiment": experiment,
        "settings": settings,
        "updates_per_second": updates / whole,
        "shares": {name: value / whole for name, value in sorted(clock.seconds.items(), key=lambda item: -item[1])},
        "seconds_to_first_update": first,
        "seconds_of_an_evaluation": evaluation,
        "evaluations": trainer.updates // trainer.evaluate_every if trainer.evaluate_every else 0,
        "updates": trainer.updates,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", nargs="+", default=["reach1d", "quadrotor", "drift"])
    parser.add_argument("--updates", type=int, default=300)
    parser.add_argument("--json", type=Path)
    arguments, settings = parser.parse_known_args()
    rows = []
    for experiment in arguments.experiments:
        for physics in ((), PHYSICS):
            row = measure(experiment, [*settings, *physics], arguments.updates)
            rows.append(row)
            print(f"\n{experiment}{', with the losses of the physics' if physics else ''}: ", end="")
            print(f"{row['updates_per_second']:.1f} updates a second, {torch.get_num_threads()} threads")
            for name, share in row["shares"].items():
                print(f"  {share:6.1%}  {1e3 * share / row['updates_per_second']:7.2f} ms  {name}")
            print(f"  first update after {row['seconds_to_first_update']:.1f} s; ", end="")
            print(f"{row['evaluations']} evaluations of {row['seconds_of_an_evaluation']:.1f} s each in a run")
    save(arguments.json, {}, rows=rows)


if __name__ == "__main__":
    main()
