"""The default recipe on problems of other kinds than those of the suite, against the grid.

    python benchmarks/own_problems.py [NAME ...] [--seed 50] [--states 31000] [--rollouts 1000]
        [--settings KEY=VALUE ...] [--out FOLDER] [--json FILE]

docs/suite.md says which of the problems had a part in choices, and in which. V and the success of the learned policy
are compared with the grid, in the way of the suite, at 400 states, which `--states` draws. There is no truth with
three states and two controls, or with more states. Bearing and Mirror are exceptions: they are compared with the
products of the grids of their independent subsystems. A run takes minutes. What is done already in the folder is not
repeated: neither a training, so that other settings need another folder, nor a measurement at the same states with as
many rollouts.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path

import torch
import yaml

import pirl_rl
from benchmarks.kinds import PROBLEMS, Mixture
from benchmarks.record import save
from pirl_rl.grid import GridSolver
from pirl_rl.sampling.initial_states import sample_interior
from pirl_rl.scoring import Score, Truth, find_truth, markdown, measure
from pirl_rl.scoring.truth import EARLIEST

POINTS = {1: 801, 2: 161, 3: 81}
"""The nodes of the grid along each axis, by the number of states."""

STATES = 400


def truth_by_parts(problem: Mixture, seed: int) -> Truth:
    """The reference values of a mixture: V is the product of those that the grid has for its subsystems."""
    rng = torch.Generator().manual_seed(seed)
    x = sample_interior(problem, problem.states, STATES, rng, torch.float64)
    tau = problem.horizon * (EARLIEST + (1 - EARLIEST) * torch.rand(len(x), generator=rng, dtype=x.dtype))
    value, error = torch.ones_like(tau), 0.0
    for part, z in problem.split(x):
        # Everything that stays within the bounds of a subsystem lies in its box.
        grid = GridSolver(part, POINTS[part.states.dim], margin=[0.0] * part.states.dim).solve()
        value, error = value * grid.value(tau, z), error + float(grid.error(tau, z).mean())
    return Truth(tau, x, value, "grid", error)


def measured(name: str, arguments: argparse.Namespace, settings: dict) -> Score:
    """Train a problem, or load its finished run, and compare it with the grid."""
    problem, seed = PROBLEMS[name](), arguments.seed
    folder = arguments.out / f"{name}-{seed}"
    known = folder / f"score-{arguments.states}-{arguments.rollouts}.json"
    if known.is_file():
        return Score.load(known)
    if isinstance(problem, Mixture):
        truth = truth_by_parts(problem, arguments.states)
    else:
        truth = find_truth(problem, STATES, arguments.states, POINTS)
    if not (folder / "summary.json").exists():
        pirl_rl.train(problem, folder=folder, seed=seed, report=False, **{"evaluation.during": []}, **settings)
    run = pirl_rl.load_run(folder, problem=problem)
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    seconds, updates = summary["wall_seconds"], int(summary["updates"])
    score = measure(run.solution, run.simulator, truth, arguments.rollouts, seconds, updates)
    score.save(known)
    return score


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PROBLEMS)}; all by default")
    parser.add_argument("--seed", type=int, default=50, help="of the trainings")
    parser.add_argument("--states", type=int, default=31_000, help="seed of the states; no training uses it")
    parser.add_argument("--rollouts", type=int, default=1_000, help="paths from each state")
    parser.add_argument("--settings", nargs="*", default=[], metavar="KEY=VALUE", help="of all trainings")
    parser.add_argument("--out", type=Path, default=Path("runs/own_problems"))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if unknown := {*arguments.names} - PROBLEMS.keys():
        parser.error(f"expected names out of {', '.join(PROBLEMS)}, got {', '.join(sorted(unknown))}")
    settings = {key: yaml.safe_load(value) for key, _, value in (text.partition("=") for text in arguments.settings)}
    scores = {name: measured(name, arguments, settings) for name in arguments.names or PROBLEMS}
    found = {name: asdict(score) for name, score in scores.items()}
    asked = {key: getattr(arguments, key) for key in ("seed", "states", "rollouts")}
    save(arguments.json, {}, **asked, settings=settings, problems=found)
    sources = {name: "none" if math.isnan(score.mse) else "grid" for name, score in scores.items()}
    print(markdown({name: [score] for name, score in scores.items()}, sources))


if __name__ == "__main__":
    main()
