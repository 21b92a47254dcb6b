"""Run all benchmarks of speed, print their tables, and compare their ratios with the stored ones.

    python -m benchmarks [--short] [--json FILE] [--store]

    --short      at most a minute and a half on one core: only ratios that hardly vary from run to run
    --json FILE  the file of all results and of the machine, runs/benchmarks.json by default
    --store      make the ratios of this run those with which later runs are compared, in benchmarks/ratios.json

Each benchmark runs in a process of its own with one thread. One that needs a package or a device that is not there is
left out with a sentence. The results are written after each benchmark, so that an interrupted run leaves what it has
measured. A ratio that has become worse gets a warning, and the exit status stays 0. Where a benchmark fails, the others
run, the exit status is 1, and nothing is stored.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from benchmarks.ratios import STORED, compare, read, table
from benchmarks.record import save

FOLDER = Path(__file__).parent

ALL = {
    "learner": "learner.py",
    "peers": "peers.py",
    "dimension": "dimension.py",
    "simulator": "simulator.py",
    "training profile": "training_profile.py",
    "products": "products.py",
    "population": "population.py",
    "gpu": "gpu.py",
    "data parallel": "data_parallel.py",
    "collector, sync": "collectors.py collector=sync +experiment=reach1d --updates 1500 --seconds 20",
    "collector, multi_async": "collectors.py collector=multi_async collector.workers=2 +experiment=reach1d "
    "--updates 1500 --seconds 20",
    "deployment": "deployment.py",
    "imports": "imports.py",
    "grid": "grid.py",
    "time to accuracy": "time_to_accuracy.py",
}
"""The commands of the benchmarks, by name."""

SHORT = {
    "learner": "learner.py --short",
    "dimension": "dimension.py --short",
    "simulator": "simulator.py --short",
}
"""Those of the short version."""

ON_GPU = {"gpu"}
"""Those that need a CUDA device."""

NEEDS = {"peers": ("stable_baselines3", "gymnasium"), "deployment": ("onnx", "onnxruntime", "onnxscript")}
"""The modules that a benchmark needs beside those of the package, by name."""


class Failure(str):
    """A sentence that says how a benchmark failed."""


def run(commands: Mapping[str, str]) -> Iterator[tuple[str, dict[str, Any] | str]]:
    """Run benchmarks one after the other, which print their tables.

    Args:
        commands: files of `FOLDER` with their arguments, by the name of the benchmark.

    Yields:
        The name of each benchmark, and its record, or a sentence that says why there is none.
    """
    path = os.pathsep.join(filter(None, [str(FOLDER.parent), os.environ.get("PYTHONPATH", "")]))
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    for name, command in commands.items():
        print(f"\n## {name}: {command}\n", flush=True)
        missing = [module for module in NEEDS.get(name, ()) if importlib.util.find_spec(module) is None]
        if missing:
            yield name, f"The benchmark needs {' and '.join(missing)}, which this Python does not have."
            continue
        if name in ON_GPU and not torch.cuda.is_available():
            yield name, "The benchmark needs a CUDA device, which this machine does not have."
            continue
        with tempfile.TemporaryDirectory() as folder:
            result, (file, *arguments) = Path(folder) / "record.json", shlex.split(command)
            line = [sys.executable, str(FOLDER / file), *arguments, "--json", str(result)]
            status = subprocess.run(line, env=environment, check=False).returncode
            done = status == 0 and result.is_file()
            failure = Failure(f"The benchmark failed with exit status {status}.")
            yield name, json.loads(result.read_text()) if done else failure


def collect(commands: Mapping[str, str], path: Path) -> tuple[dict[str, float], list[str]]:
    """Run benchmarks, and write what they find to one file after each of them.

    Args:
        commands: see `run`.
        path: the file of all results.

    Returns:
        The ratios of all benchmarks, by name, and the names of benchmarks that failed.
    """
    found: dict[str, Any] = {}
    skipped: dict[str, str] = {}
    ratios: dict[str, float] = {}
    for name, record in run(commands):
        if isinstance(record, str):
            print(f"skipped: {record}", flush=True)
            skipped[name] = record
        else:
            ratios |= {f"{name}: {ratio}": value for ratio, value in record.pop("ratios").items()}
            del record["machine"]  # it stands once for all
            found[name] = record
        save(path, ratios, skipped=skipped, benchmarks=found)
    return ratios, [name for name, reason in skipped.items() if isinstance(reason, Failure)]


def main(stored: Path = STORED) -> None:
    """The command.

    Args:
        stored: the file of the stored ratios.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--json", type=Path, default=Path("runs/benchmarks.json"))
    parser.add_argument("--store", action="store_true")
    arguments = parser.parse_args()
    (ratios, failed), earlier = collect(SHORT if arguments.short else ALL, arguments.json), read(stored)
    print(f"\n## ratios, of which larger ones are better\n\n{table(ratios, earlier['ratios'])}\n")
    if not arguments.store:
        print("\n".join(compare(ratios, earlier["ratios"])))
        print(f"The stored ratios are those of {earlier['machine'].get('processor', 'no machine yet')}.")
    print(f"written  {arguments.json}")
    if failed:
        sys.exit(f"error: benchmarks that failed: {', '.join(failed)}")
    if arguments.store:
        save(stored, ratios)


if __name__ == "__main__":
    main()
