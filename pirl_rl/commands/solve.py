"""Solve a problem on a grid, `python -m pirl_rl.train +experiment=zermelo method=grid`, in place of a training."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from pirl_rl.assembly import make_evaluation_simulator, make_evaluators, make_grid_solver, make_problem
from pirl_rl.automatic import choose_paths, choose_time_steps
from pirl_rl.commands.directory import show_run
from pirl_rl.configuration import save_config
from pirl_rl.evaluation import evaluate, meanings_of, metrics_of, statements_of
from pirl_rl.files import replacing
from pirl_rl.machine import record_session
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.reports.meanings import GRID
from pirl_rl.run_directory import RunDirectory
from pirl_rl.structure import check_problem


def solve(
    config: DictConfig,
    folder: Path,
    overrides: Sequence[str],
    trust: Sequence[str] = (),
    problem: ReachAvoidProblem | None = None,
) -> dict[str, float]:
    """Solve the problem of a configuration, and leave a run directory; returns the summary.

    Args:
        config: the configuration, with the node `grid`.
        folder: the run directory, which exists.
        overrides: the overrides of the user, which are recorded.
        trust: modules outside the package that the configuration may name.
        problem: replaces `env.problem`.

    Raises:
        PirlError: if the configuration cannot be built, or the problem does not suit a grid.
    """
    run = RunDirectory(folder)
    problem = make_problem(config, trust) if problem is None else problem
    solver = make_grid_solver(config, problem, trust)
    check_problem(problem)
    choose_time_steps(config, problem)
    choose_paths(config, problem, make_evaluation_simulator(config, problem))
    evaluators = make_evaluators(config.evaluation, "final", trust)
    print(f"solving on a grid of {' x '.join(map(str, solver.points))} nodes across the box of states", flush=True)
    started = time.perf_counter()
    # Evaluators and figures take what has the methods of a solution.
    solution: Any = solver.solve()
    seconds = time.perf_counter() - started
    # The configuration comes last: a directory with it counts as begun, and must tell its overrides.
    OmegaConf.save(overrides, run.overrides)
    save_config(config, folder)
    record_session(run, overrides, "cpu")
    solution.save(run.grid)
    evidence = evaluate(solution, make_evaluation_simulator(config, problem), evaluators)
    error = {"grid_error": solution.largest_error} if solver.estimate else {}
    summary = {"wall_seconds": seconds, "grid_nodes": float(np.prod(solution.mesh.shape)), **error}
    summary |= metrics_of(evidence)
    with replacing(run.summary) as file:
        file.write(json.dumps(statements_of(evidence) | summary, indent=2) + "\n")
    meanings = {"grid": GRID} | meanings_of(evaluators, problem)
    show_run(run, solution, evidence, summary, meanings, config, trust)
    return summary
