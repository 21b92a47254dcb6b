"""The meaning of every entry of summary.json and evaluation.json, by the part of the program that measured it."""

from __future__ import annotations

import copy
from collections.abc import Sequence

from omegaconf import DictConfig

from pirl_rl.assembly import make_evaluators
from pirl_rl.errors import PirlError
from pirl_rl.evaluation import meanings_of
from pirl_rl.problem import ReachAvoidProblem

TRAINING = {
    "updates": "The number of updates of the networks.",
    "wall_seconds": "The time that they took, in s, without the evaluation at the end.",
    "updates_per_second": "updates / wall_seconds.",
    "collapsed_at": "The update at which the run collapsed.",
    "rolled_back_to": "The update whose networks the run ended with.",
}
"""The meanings of what the trainer writes."""

GRID = {
    "wall_seconds": "The time of the solution, in s.",
    "grid_nodes": "The number of nodes of the mesh.",
    "grid_error": "The largest difference at tau = T from the solution with half as many points and steps. "
    "What a wider mesh would change is added, and it is 1 where the error is not known.",
}
"""The meanings of what a run with method=grid writes."""

TITLES = {
    "run": "Without a recorded meaning",
    "training": "Training",
    "grid": "Solution on the grid",
    "exact": "Error against the exact V",
    "residuals": "Held-out losses",
    "success": "Success of the policy",
    "calibration": "V against simulation of the policy",
    "accuracy": "Accuracy on reference states",
    "slices": "V against simulation on planes",
    "rollouts": "Sample paths",
    "verdict": "What the verdict rests on",
}
"""Titles of the groups of metrics; other evaluators have their name as a title."""


def meanings(config: DictConfig, problem: ReachAvoidProblem, trust: Sequence[str]) -> dict[str, dict[str, str]]:
    """The meanings of all metrics that a run may have, by group and metric.

    Those of all evaluators that the configuration describes are included, because a later evaluation may have called
    others than the training. If one of them cannot be built, the final evaluators of the run are taken alone.
    """
    first = {"grid": GRID} if config.get("grid") is not None else {"training": TRAINING}
    every = copy.deepcopy(config.evaluation)
    nodes = [str(name) for name in every if isinstance(every[name], DictConfig) and "_target_" in every[name]]
    every.final = [name for name in nodes if name != "simulator"]
    try:
        return first | meanings_of(make_evaluators(every, "final", trust), problem)
    except PirlError:
        return first | meanings_of(make_evaluators(config.evaluation, "final", trust), problem)
