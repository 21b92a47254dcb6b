"""Accuracy and time of the grid solver: closed forms at three meshes, and Monte Carlo of its own policy.

It also compares the success of a run's policy with that of the grid's.

python benchmarks/grid.py [--json FILE]   # one and two dimensions
python benchmarks/grid.py --own DubinsCar   # V against Monte Carlo of the grid's own policy, some minutes
python benchmarks/grid.py --run RUN_DIR   # a run with at most three states
python benchmarks/grid.py --run RUN_DIR --own HerdImmunity   # likewise, of a problem of `benchmarks.kinds`
"""

from __future__ import annotations

import argparse
import math
import resource
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.kinds import PROBLEMS
from benchmarks.record import save
from pirl_rl import load_run
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.grid import GridSolver
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import DubinsCar, Exit1D, HalfSpace, RadialExit, Reach1D
from pirl_rl.scoring.truth import DOUBT

MESHES = ((Reach1D(), (101, 201, 401)), (Exit1D(), (101, 201, 401)))
MESHES += ((HalfSpace(dim=2), (41, 81, 121)), (RadialExit(dim=2), (41, 81, 121)))


def states(problem, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Random states outside A and B, with times to go in the second half of the horizon."""
    rng = torch.Generator().manual_seed(seed)
    x = problem.states.sample(4 * count, rng, torch.float64)
    x = x[problem.interior(x)][:count]
    return problem.horizon * (0.5 + 0.5 * torch.rand(len(x), generator=rng, dtype=x.dtype)), x


def closed_forms() -> list[dict[str, Any]]:
    """Print and return the largest error, its estimate, the observed order and the seconds for each mesh."""
    rows = []
    print("| Problem | Points | Largest error | Estimate | Order | Seconds |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for problem, meshes in MESHES:
        before, previous, (tau, x) = math.nan, math.nan, states(problem, 2_000)
        for points in meshes:
            started = time.perf_counter()
            solution = GridSolver(problem, points).solve()
            seconds = time.perf_counter() - started
            error = (solution.value(tau, x) - problem.exact_value(tau, x)).abs().max().item()
            estimate, order = solution.error(tau, x).max().item(), math.log(before / error, points / previous)
            name = type(problem).__name__
            print(f"| {name} | {points} | {error:.1e} | {estimate:.1e} | {order:.2f} | {seconds:.1f} |")
            found = {"error": error, "estimate": estimate, "order": None if math.isnan(order) else order}
            rows.append({"problem": name, "points": points, **found, "seconds": seconds})
            before, previous = error, points
    return rows


def against_itself(problem: ReachAvoidProblem, points: int, seed: int, rollouts: int) -> None:
    """Print V against Monte Carlo of the grid's own policy at 50 states.

    V is that of a control that is never held, so that Monte Carlo holds it for a two-thousandth of the horizon.
    """
    started = time.perf_counter()
    solution = GridSolver(problem, points).solve()
    seconds, (tau, x) = time.perf_counter() - started, states(problem, 50, seed)
    played = monte_carlo(problem, solution.policy, tau, x, rollouts=rollouts, dt=problem.horizon / 2_000)
    value = solution.value(tau, x)
    distance = (value - torch.as_tensor(played.probability)).abs()
    # The standard error if V is right: that of Monte Carlo's own estimate is 0 where no path, or every path, succeeds.
    noise = (value * (1 - value) / rollouts).sqrt()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{type(problem).__name__}, {points} points, {seconds:.0f} s, {memory:.1f} GiB")
    root = distance.square().mean().sqrt()
    print(f"mean |V - MC| {distance.mean():.4f}, root mean square {root:.4f}, largest {distance.max():.4f}")
    print(f"success of the policy {played.probability.mean():.4f}, mean V {value.mean():.4f}")
    estimate, within = solution.error(tau, x), (distance <= 3 * noise).double()
    trusted = estimate <= DOUBT
    print(f"mean estimate of the error of V {estimate.mean():.4f}")
    print(f"share of the states within three standard errors {within.mean():.2f}")
    print(f"of the {trusted.sum()} states with an estimate of at most {DOUBT} {within[trusted].mean():.2f}")


def against(
    run_dir: str,
    problem: ReachAvoidProblem | None,
    points: int,
    steps: int | None,
    seed: int,
    rollouts: int,
    count: int = 400,
) -> None:
    """Print the mean success of a run's policy and of the grid's, at the same states and with the same noise.

    The directory of a run that was given an object as its problem does not have the problem.
    """
    run = load_run(run_dir, problem=problem)
    problem, simulator = run.problem, run.simulator
    solution, (tau, x) = GridSolver(problem, points, steps).solve(), states(problem, count, seed)
    clock = {"dt": simulator.dt, "substeps": simulator.substeps, "crossing": simulator.crossing}
    for name, policy in (("run", run.solution.policy), ("grid", solution.policy)):
        played = monte_carlo(problem, policy, tau, x, rollouts=rollouts, **clock)
        error = (played.probability * (1 - played.probability) / rollouts).sum().sqrt() / len(x)
        print(f"success of the {name}'s policy {played.probability.mean():.4f} +- {error:.4f}", flush=True)
    print(f"mean V of the grid {solution.value(tau, x).mean():.4f}, estimate {solution.error(tau, x).mean():.4f}")
    print(f"mean V of the run {run.solution.value(tau, x).mean():.4f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    own = {**PROBLEMS, "DubinsCar": DubinsCar}
    parser.add_argument(
        "--own", choices=own, help="compare V with Monte Carlo of the grid's own policy; with --run its problem"
    )
    parser.add_argument("--points", type=int, default=51, help="nodes along each axis")
    parser.add_argument(
        "--steps", type=int, help="steps in time to go, with --run; by default they follow from the problem"
    )
    parser.add_argument("--run", help="compare the policy of this run directory with the grid's")
    parser.add_argument("--seed", type=int, default=0, help="of the states, with --run and --own")
    parser.add_argument(
        "--rollouts", type=int, help="paths from each state; 400 with --run, and 2,000 with --own alone"
    )
    parser.add_argument("--json", type=Path, help="write what is found in one and two dimensions to this file")
    arguments = parser.parse_args()
    if arguments.run:
        problem = own[arguments.own]() if arguments.own else None
        paths = arguments.rollouts or 400
        against(arguments.run, problem, arguments.points, arguments.steps, arguments.seed, paths)
    elif arguments.own:
        against_itself(own[arguments.own](), arguments.points, arguments.seed, arguments.rollouts or 2_000)
    else:
        save(arguments.json, {}, rows=closed_forms())
