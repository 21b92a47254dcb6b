"""Updates a second on a GPU, alone and in a population, against eager PyTorch on the same GPU.

    python benchmarks/gpu.py [--experiments drift reach1d] [--members 64] [--updates 200] [--json FILE]

"eager" is a run whose losses and simulator are not compiled and whose kernels Python launches one by one. "recorded" is
a run as the package trains it, and "recorded, M members" a population of M seeds; see `pirl_rl.recording`. Each row
comes from a process of its own, with the default recipe, without evaluations and checkpoints. The time of an update is
the mean over `--updates` updates after the first 110, with the steps that are played for them.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import torch

from benchmarks.population import train
from benchmarks.record import save
from pirl_rl import recording

EAGER = "eager"

WARM_UP = 110
"""The number of updates within which everything is compiled and recorded."""


def measure(members: int, settings: list[str], updates: int, started: float, eager: bool) -> dict[str, float]:
    """`benchmarks.population.train` on the GPU.

    Args:
        members, settings, updates, started: its arguments.
        eager: whether nothing is compiled and nothing is recorded.

    Returns:
        What it returns, and the largest memory of the GPU in use, in GiB.
    """
    if eager:
        recording.records = lambda device: False
    found = train(members, [*settings, f"compile={not eager}"], updates, 1, started, WARM_UP)
    return found | {"memory": torch.cuda.max_memory_allocated() / 2**30}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", nargs="+", default=["drift", "reach1d"])
    parser.add_argument("--members", type=int, default=64)
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("this benchmark needs a CUDA device, and there is none")
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}\n")
    print("| | start, s | ms per update of each member | updates x members per second | times eager | GiB |")
    print("|---|---:|---:|---:|---:|---:|", flush=True)
    rows, ratios = [], {}
    for experiment in arguments.experiments:
        settings = [f"+experiment={experiment}", "device=cuda"]
        eager = None
        for name, members in (EAGER, 1), ("recorded", 1), (f"recorded, {arguments.members} members", arguments.members):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                work = members, settings, arguments.updates, time.monotonic(), name == EAGER
                rows.append({"row": f"{experiment}, {name}"} | pool.submit(measure, *work).result())
            last = rows[-1]
            each = last["update seconds"]
            eager = eager or each
            times = ratios[f"{experiment}, {name} / eager"] = eager / each
            print(
                f"| {last['row']} | {last['start seconds']:.0f} | {1e3 * each:.3f} | {1 / each:.0f} | {times:.1f} | "
                f"{last['memory']:.1f} |",
                flush=True,
            )
            save(arguments.json, ratios, "cuda", rows=rows)


if __name__ == "__main__":
    main()
