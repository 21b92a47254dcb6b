"""Runs of the drifting problem on eight draws of states on which nothing was chosen, with standard errors.

    python benchmarks/drift_draws.py RUN_DIR ... [--weights DIR] [--rollouts N] --out FILE

Each row is a mean over the draws `benchmarks/draws`, see `drift_states.py`, plus or minus the standard error of that
mean. MSE compares V with the Monte Carlo of the learned policy under the simulator *fine*, over the states with
friction inside the band of the targets, and over the two farthest fifths of all states. With DIR, the folder of the
paper's networks, these have rows of their own. FILE gets the table in Markdown.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from drift_baselines import Baseline

from pirl_rl import load_run
from pirl_rl.evaluation import Accuracy
from pirl_rl.evaluation.reference_states import ReferenceStates
from pirl_rl.simulator import Simulator

DRAWS = sorted(Path(__file__).with_name("draws").glob("*.npz"))

COLUMNS = {"success": "Success", "mse_band": "Band MSE", "mse_far": "Far fifth", "mse_farthest": "Farthest fifth"}

FINE = {"fine": {"dt": 0.1, "substeps": 10, "crossing": "endpoint"}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--rollouts", type=int, default=128)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    models: dict[str, Any] = {str(folder): load_run(folder).solution for folder in arguments.runs}
    if arguments.weights is not None:
        models |= {path.stem: Baseline(path) for path in sorted(arguments.weights.glob("*.npz"))}
    lines = [f"| | {' | '.join(COLUMNS.values())} |", f"| --- |{' ---: |' * len(COLUMNS)}"]
    for name, model in models.items():
        lines.append(row(name, model, arguments.rollouts))
        print(lines[-1], flush=True)
    arguments.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


def row(name: str, model: Any, rollouts: int) -> str:
    simulator = Simulator(model.problem, **FINE["fine"])  # the evaluator has simulators of its own
    found = []
    for path in DRAWS:
        evidence = Accuracy(partial(ReferenceStates.load, path), rollouts, FINE)(model, simulator)
        found.append(evidence.metrics_under("fine"))
    cells = []
    for key in COLUMNS:
        values = np.array([metrics[key] for metrics in found])
        digits = 3 if key == "success" else 4
        cells.append(f"{values.mean():.{digits}f} +- {values.std(ddof=1) / len(values) ** 0.5:.{digits}f}")
    return f"| {name} | {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
