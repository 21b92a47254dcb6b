"""What a population costs: the time of an update of each member, beside that of a run alone.

    python benchmarks/population.py [--experiment reach1d] [--members 1 10] [--threads 1] [--updates 300] [--json FILE]
        [key=value ...]

For each number of members a process of its own trains with the default recipe and the `key=value` settings, without
evaluations and checkpoints, and stops early; one member is trained as a run alone. The start goes from the beginning of
the process to the end of the first update, with imports and with compilation as far as the cache of compiled programs
does not have it. The time of an update is a mean over `--updates` updates after a first fifty. Each time stands beside
that of the processor, in parentheses.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import torch

from benchmarks.record import save
from benchmarks.time_to_accuracy import CLOCKS, PLAIN, Clocks
from pirl_rl import checkpoint
from pirl_rl.assembly import choose, make_problem, make_trainer
from pirl_rl.commands.composition import compose
from pirl_rl.population import Population

WARM_UP = 50
"""The number of updates before those whose time is taken."""


class Measured(Exception):
    """All times are taken, so that the training can stop."""


def train(
    members: int, settings: list[str], updates: int, threads: int, started: float, warm_up: int = WARM_UP
) -> dict[str, float]:
    """Train members side by side in this process.

    Args:
        members: their number; one is trained as a run alone.
        settings: those of `python -m pirl_rl.train`.
        updates: the number of updates whose time is taken.
        threads: the number of threads of torch.
        started: see `Clocks`.
        warm_up: the number of updates before those whose time is taken.

    Returns:
        The start and the time for each member and update in seconds, by both clocks.
    """
    clocks, read = Clocks(started), {}
    torch.set_num_threads(threads)
    trainers, numbers = [], []
    config = compose("train", [*PLAIN, *settings])
    problem = make_problem(config)
    choose(config, problem)
    for seed in range(members):
        own = copy.deepcopy(config)
        own.seed = seed
        trainers.append(make_trainer(own, problem=problem))
        numbers.append(checkpoint.global_rng_states())
    step, last = trainers[0].collector.step, warm_up + updates

    def timed_step(k: int) -> None:
        # The first member plays at the beginning of an update of all.
        if k in (1, warm_up, last) and trainers[0].records:
            torch.cuda.synchronize()  # a GPU works behind Python
        read[k] = clocks.read()
        if k == last:
            raise Measured
        step(k)

    trainers[0].collector.step = timed_step  # type: ignore[method-assign]
    with contextlib.suppress(Measured):
        trainers[0].train() if members == 1 else Population(trainers, numbers).train()
    each = {f"update {name}": (read[last][name] - read[warm_up][name]) / (updates * members) for name in CLOCKS}
    return {f"start {name}": read[1][name] for name in CLOCKS} | each


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiment", default="reach1d")
    parser.add_argument("--members", nargs="+", type=int, default=[1, 10])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--updates", type=int, default=300)
    parser.add_argument("--json", type=Path)
    parser.add_argument("settings", nargs="*")
    arguments = parser.parse_args()
    settings = [f"+experiment={arguments.experiment}", *arguments.settings]
    found: dict[int, dict[str, float]] = {}
    lines = ["| members | start, s | an update of each member, ms |", "|---:|---:|---:|"]
    for members in arguments.members:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            work = (members, settings, arguments.updates, arguments.threads, time.monotonic())
            row = found[members] = pool.submit(train, *work).result()
        start, update = ([row[f"{part} {name}"] for name in CLOCKS] for part in ("start", "update"))
        lines.append(f"| {members} | {start[0]:.1f} ({start[1]:.1f}) | {1e3 * update[0]:.2f} ({1e3 * update[1]:.2f}) |")
    first, *others = found
    ratios = {
        f"updates of each member, {members} members / {first}": found[first]["update seconds"] / row["update seconds"]
        for members, row in found.items()
        if members in others
    }
    save(arguments.json, ratios, threads=arguments.threads, settings=settings, members=found)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
