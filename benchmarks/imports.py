"""CPU seconds of imports, each in a fresh process; the least of several tries.

python benchmarks/imports.py
"""

from __future__ import annotations

import subprocess
import sys

TRIES = 3
LINES = (
    "import pirl_rl",
    "import torch",
    "import torchrl.collectors, torchrl.envs, torchrl.objectives",
    "from pirl_rl import ReachAvoidProblem",
    "from pirl_rl import train",
)
MEASURE = "import time; begin = time.process_time(); {line}; print(time.process_time() - begin)"


def seconds(line: str) -> float:
    """CPU time of a line of Python, s."""
    command = [sys.executable, "-c", MEASURE.format(line=line)]
    runs = (subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(TRIES))
    return min(float(run.stdout.split()[-1]) for run in runs)


def main() -> None:
    print(f"{'import':<64} {'CPU seconds':>12}")
    for line in LINES:
        print(f"{line:<64} {seconds(line):>12.2f}")


if __name__ == "__main__":
    main()
