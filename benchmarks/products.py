"""Whole trainings with matrix products by the faster library, against those of PyTorch's default, see `fast_products`.

    python benchmarks/products.py [--experiments reach1d drift] [--rounds 9] [--updates 50] [--json FILE] [key=value]

Each experiment is trained with the default recipe and `key=value` settings. The two ways of multiplication take turns
of as many updates as follow one collection of steps, on one thread, and times are medians of the processor's. Where the
default is kept, the benchmark says so and measures nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import time
from pathlib import Path

import torch

from benchmarks.record import save
from benchmarks.training_profile import WARM_UP, loop
from pirl_rl.assembly import make_trainer
from pirl_rl.commands.composition import compose
from pirl_rl.commands.console import named_modules


def measure(experiment: str, settings: list[str], rounds: int, updates: int) -> dict[str, float] | None:
    """The milliseconds of an update, with the steps that are played for it, by the way of multiplication."""
    config = compose("train", [f"+experiment={experiment}", "device=cpu", "logger=none", *settings])
    trainer = make_trainer(config, trust=named_modules(settings))
    with trainer.products() as chosen:
        pass
    if not chosen:
        return None
    trainer._enter_stage()
    trainer.collector.start()
    loop(trainer, WARM_UP)
    times: dict[str, list[float]] = {"default": [], "faster library": []}
    for _ in range(rounds):
        for name, entries in times.items():
            with trainer.products() if name == "faster library" else contextlib.nullcontext():
                started = time.process_time()
                loop(trainer, updates)
                entries.append(1e3 * (time.process_time() - started) / updates)
    return {name: statistics.median(entries) for name, entries in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", nargs="+", default=["reach1d", "pendulum", "quadrotor", "drift"])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--updates", type=int, default=50)
    parser.add_argument("--json", type=Path)
    arguments, settings = parser.parse_known_args()
    torch.set_num_threads(1)
    found, ratios = {}, {}
    print("| experiment | default, ms | faster library, ms | ratio |\n|---|--:|--:|--:|")
    for experiment in arguments.experiments:
        row = measure(experiment, settings, arguments.rounds, arguments.updates)
        if row is None:
            print(f"| {experiment} | the default is kept | | |")
            continue
        found[experiment], slow, fast = row, row["default"], row["faster library"]
        ratios[f"products: training, {experiment}, default / faster library"] = slow / fast
        print(f"| {experiment} | {slow:.2f} | {fast:.2f} | {slow / fast:.2f} |", flush=True)
    save(arguments.json, ratios, found=found)


if __name__ == "__main__":
    main()
