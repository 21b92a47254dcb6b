"""CPU seconds of imports, each in a new process, as the smallest of several measurements.

python benchmarks/imports.py [--json FILE]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from benchmarks.record import save

TRIES = 3
STATEMENTS = (
    "import pirl_rl",
    "import torch",
    "import torchrl.collectors, torchrl.envs, torchrl.objectives",
    "from pirl_rl import ReachAvoidProblem",
    "from pirl_rl import train",
    "import pirl_rl.commands.train",
)
MEASURE = "import time; start = time.process_time(); {statement}; print(time.process_time() - start)"


def seconds(statement: str) -> float:
    """CPU time of a Python statement in s."""
    command = [sys.executable, "-c", MEASURE.format(statement=statement)]
    runs = (subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(TRIES))
    return min(float(run.stdout.split()[-1]) for run in runs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found = {}
    print(f"{'import':<64} {'CPU seconds':>12}")
    for statement in STATEMENTS:
        found[statement] = seconds(statement)
        print(f"{statement:<64} {found[statement]:>12.2f}")
    save(arguments.json, {}, seconds=found)


if __name__ == "__main__":
    main()
