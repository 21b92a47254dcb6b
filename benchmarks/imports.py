"""CPU seconds of imports, each in a new process, as the smallest of several measurements.

python benchmarks/imports.py
"""

from __future__ import annotations

import subprocess
import sys

TRIES = 3
STATEMENTS = (
    "import pirl_rl",
    "import torch",
    "import torchrl.collectors, torchrl.envs, torchrl.objectives",
    "from pirl_rl import ReachAvoidProblem",
    "from pirl_rl import train",
)
MEASURE = "import time; start = time.process_time(); {statement}; print(time.process_time() - start)"


def seconds(statement: str) -> float:
    """CPU time of a Python statement in s."""
    command = [sys.executable, "-c", MEASURE.format(statement=statement)]
    runs = (subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(TRIES))
    return min(float(run.stdout.split()[-1]) for run in runs)


def main() -> None:
    print(f"{'import':<64} {'CPU seconds':>12}")
    for statement in STATEMENTS:
        print(f"{statement:<64} {seconds(statement):>12.2f}")


if __name__ == "__main__":
    main()
