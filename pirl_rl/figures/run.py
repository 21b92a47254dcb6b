"""All figures of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pirl_rl.evaluation import Evidence
from pirl_rl.figures.evidence import draw_all
from pirl_rl.figures.files import save_figures
from pirl_rl.figures.one_dimensional import draw_policy, draw_surface, draw_value, evaluate_on_grid
from pirl_rl.figures.training import draw_training
from pirl_rl.loggers import read_metrics
from pirl_rl.solution import Solution


def draw_run(
    solution: Solution, metrics_path: str | Path, folder: str | Path, evidence: Mapping[str, Evidence] | None = None
) -> list[Path]:
    """Draw the training curves, the figures of a one-dimensional solution, and the figures of the evidence.

    Args:
        solution: the value and the policy.
        metrics_path: the run's metrics.csv; if it does not exist, there are no training curves.
        folder: the folder to which the figures are written.
        evidence: the evidence about this solution, by the evaluators' names.

    Returns:
        The paths of the figures.
    """
    figures = {"training": draw_training(read_metrics(metrics_path))} if Path(metrics_path).is_file() else {}
    if solution.problem.states.dim == 1:
        grid = evaluate_on_grid(solution)
        figures |= {"surface": draw_surface(grid), "value": draw_value(grid), "policy": draw_policy(grid, solution)}
    return save_figures(figures | draw_all(evidence or {}), folder)
