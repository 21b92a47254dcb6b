"""Whether two processes that share each batch train faster than one, by PyTorch's `torch.distributed` with gloo.

    python benchmarks/data_parallel.py [--dims 32 100] [--processes 2] [--updates 200] [--json FILE] [key=value ...]

The problem is the half-space with `--dims` states, and the recipe is the default one with the `key=value` settings.
Each of the processes has one thread, plays its share of the environments, and evaluates the losses on its share of the
batch. The gradients are averaged over the processes before each step of an optimiser, so that all have the same
networks. Beside that stands one process with the whole batch, with one thread and with as many threads as there are
processes.

The time of an update is a mean over `--updates` updates after a first fifty. Evaluations and checkpoints are left out.
"""

from __future__ import annotations

import argparse
import contextlib
import socket
import time
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
import torch.distributed

from benchmarks.population import WARM_UP, Measured
from benchmarks.record import save
from benchmarks.time_to_accuracy import PLAIN
from pirl_rl.assembly import choose, make_problem, make_trainer
from pirl_rl.commands.composition import compose
from pirl_rl.gradients import Gradient
from pirl_rl.trainer import Trainer

SHARED = ("env.num_envs", "collector.frames_per_batch", "collector.warmup_frames", "trainer.batch_size")
"""The settings of which each process has its share."""


def average(gradient: Gradient) -> Gradient:
    """A loss with its gradient averaged over the processes."""
    loss, terms, entries = gradient
    given = [entry for entry in entries if entry is not None]
    flat = torch.cat([entry.reshape(-1) for entry in given])
    torch.distributed.all_reduce(flat)
    flat /= torch.distributed.get_world_size()
    parts = iter(flat.split([entry.numel() for entry in given]))
    averaged = tuple(None if entry is None else next(parts).view(entry.shape) for entry in entries)
    return loss, terms, averaged


def share_gradients(trainer: Trainer) -> None:
    """Let the optimisers of a trainer step along the mean gradient of all processes."""
    learner = trainer.learner
    critics, actor = learner.lead_critics, learner.lead_actor
    learner.lead_critics = lambda found, k: critics(average(found), k)  # type: ignore[method-assign]
    learner.lead_actor = lambda found, k: actor(average(found), k)  # type: ignore[method-assign]


def train(rank: int, processes: int, port: int, settings: list[str], threads: int, updates: int, result: Any) -> None:
    """Train in this process, and put the seconds of an update into the result.

    Args:
        rank: the number of this process, from 0.
        processes: the number of processes.
        port: that of this machine by which they find each other.
        settings: those of `python -m pirl_rl.train` for the whole batch.
        threads: the number of threads of torch.
        updates: the number of updates whose time is taken.
        result: the seconds of each process, shared by all.
    """
    torch.set_num_threads(threads)
    whole = compose("train", settings)
    choose(whole, make_problem(whole))
    shares = [f"{key}={_read(whole, key) // processes}" for key in SHARED]
    trainer = make_trainer(compose("train", [*settings, *shares]))
    if processes > 1:
        torch.distributed.init_process_group(
            "gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=processes
        )
        share_gradients(trainer)
        # Noise and starts differ between the processes, networks do not.
        trainer.collector.env.rng.manual_seed(rank)  # type: ignore[attr-defined]
    step, started = trainer.collector.step, 0.0

    def timed_step(k: int) -> None:
        nonlocal started
        if k == WARM_UP:
            started = time.perf_counter()
        if k == WARM_UP + updates:
            result[rank] = (time.perf_counter() - started) / updates
            raise Measured
        step(k)

    trainer.collector.step = timed_step  # type: ignore[method-assign]
    with contextlib.suppress(Measured):
        trainer.train()
    if processes > 1:
        torch.distributed.destroy_process_group()


def measure(processes: int, threads: int, settings: list[str], updates: int) -> float:
    """The seconds of an update, of the slowest process."""
    context = get_context("spawn")
    result = context.Array("d", processes)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    workers = [
        context.Process(target=train, args=(rank, processes, port, settings, threads, updates, result))
        for rank in range(processes)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    if any(worker.exitcode for worker in workers):
        raise RuntimeError(f"a process ended with the status {[worker.exitcode for worker in workers]}")
    return max(result[:])


def _read(config: Any, key: str) -> int:
    group, name = key.split(".")
    return config[group][name]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dims", nargs="+", type=int, default=[32, 100])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--json", type=Path)
    parser.add_argument("settings", nargs="*")
    arguments = parser.parse_args()
    count, rows, ratios = arguments.processes, [], {}
    lines = [f"| states | one thread, ms | {count} threads, ms | {count} processes, ms |", "|---:|---:|---:|---:|"]
    for dim in arguments.dims:
        settings = ["+experiment=halfspace", f"env.problem.dim={dim}", *PLAIN, "seed=0", *arguments.settings]
        one, threads, processes = (
            measure(*kind, settings, arguments.updates) for kind in ((1, 1), (1, count), (count, 1))
        )
        rows.append({"states": dim, "one thread": one, "threads": threads, "processes": processes})
        ratios[f"updates with {count} processes / one with {count} threads, n = {dim}"] = threads / processes
        lines.append(f"| {dim} | {1e3 * one:.1f} | {1e3 * threads:.1f} | {1e3 * processes:.1f} |")
        save(arguments.json, ratios, processes=count, settings=arguments.settings, rows=rows)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
