"""Transitions per second of a collector, with a learner that waits and with one that learns.

    python benchmarks/collectors.py collector=sync|multi_async|ray [key=value ...] [--updates 1000] [--seconds 30]
        [--json FILE]

The settings are those of `python -m pirl_rl.train`; without an experiment it is drift with the default recipe, in one
stage. First come 100 updates, in which all processes compile what they need. Then the learner waits for some seconds
and only takes what is played. Then it makes further updates, and both rates are counted in the same time. The learner
has one thread, and so has each worker if OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from benchmarks.record import save
from pirl_rl.assembly import make_trainer
from pirl_rl.commands.composition import compose

WARMUP = 100
"""Updates before anything is measured."""

PLAIN = ("trainer.evaluate_every=0", "trainer.checkpoint_every=0", "trainer.checkpoint_seconds=0", "logger=none")
PLAIN += ("evaluation.during=[]", "evaluation.final=[]", "pirl.stages=[]")


def measure(overrides: list[str], updates: int, seconds: float) -> dict[str, float]:
    """The four numbers of a row, by name."""
    config = compose("train", [*overrides, *PLAIN, f"trainer.updates={WARMUP + updates}"])
    trainer = make_trainer(config)
    collector, start, step = trainer.collector, trainer.collector.start, trainer.collector.step
    first = 0 if config.collector._target_.endswith("SyncCollector") else 1  # at update 1 it takes what workers played
    marks: dict[str, tuple[float, int]] = {}

    def mark(name: str) -> None:
        marks[name] = time.perf_counter(), collector.buffer.write_count

    def timed_start() -> None:
        mark("start")
        start()
        mark("started")

    def timed_step(update: int) -> None:
        if update == WARMUP:
            mark("waits")
            while time.perf_counter() < marks["waits"][0] + seconds:
                step(first)
                time.sleep(0 if first == 0 else 0.005)
            mark("learns")
        step(update)
        if update == WARMUP + updates - 1:
            mark("end")

    collector.start, collector.step = timed_start, timed_step  # type: ignore[method-assign]
    trainer.train()

    def rate(begin: str, end: str) -> float:
        (before, few), (after, many) = marks[begin], marks[end]
        return (many - few) / (after - before)

    began, ended = marks["learns"][0], marks["end"][0]
    return {
        "seconds until the warm-up was played": marks["started"][0] - marks["start"][0],
        "transitions a second, waiting": rate("waits", "learns"),
        "transitions a second, learning": rate("learns", "end"),
        "updates a second": updates / (ended - began),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", nargs="+", metavar="key=value")
    parser.add_argument("--updates", type=int, default=1_000)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    named = any(text.startswith("+experiment=") for text in arguments.settings)
    settings = arguments.settings if named else ["+experiment=drift", *arguments.settings]
    found = measure(settings, arguments.updates, arguments.seconds)
    print(f"| settings | {' | '.join(found)} |\n|---|{'--:|' * len(found)}")
    print(f"| {' '.join(settings)} | {' | '.join(f'{number:,.1f}' for number in found.values())} |")
    save(arguments.json, {}, settings=settings, rates=found)


if __name__ == "__main__":
    main()
