"""Opening a run from its directory."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import cast

from pirl_rl import checkpoint
from pirl_rl.assembly import make_networks, make_problem
from pirl_rl.building import trusted_modules
from pirl_rl.checkpoint import check_module
from pirl_rl.configuration import load_config
from pirl_rl.continuation import fitting
from pirl_rl.errors import ArgumentError
from pirl_rl.grid import GridSolution
from pirl_rl.networks import stack
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.run import Run
from pirl_rl.solution import Solution


def load_run(
    folder: str | PathLike[str],
    trust: Sequence[str] | str = (),
    weights: str | None = None,
    device: str = "cpu",
    problem: ReachAvoidProblem | None = None,
) -> Run:
    """Open a run directory.

    Args:
        folder: a directory that training or `python -m pirl_rl.export` wrote.
        trust: modules outside pirl_rl that its configuration may name, such as the module of your own problem;
            a list or one name.
        weights: name of a file in `checkpoints/`; the default is the latest.
        device: device of the networks.
        problem: replaces `env.problem`, for a run that was trained on an object, which no configuration can name.

    Raises:
        ArgumentError: if the folder is no path, or `problem` is no problem.
        ConfigError: if the folder is not a run directory, or its configuration names a class that is not trusted, or no
            problem.
        CheckpointError: if the checkpoint is missing, broken or does not fit the configuration.
    """
    trust = trusted_modules(trust)
    if not isinstance(folder, (str, PathLike)):
        raise ArgumentError(f"folder: expected the path of a run directory, got {folder!r}")
    if not (problem is None or isinstance(problem, ReachAvoidProblem)):
        raise ArgumentError(f"problem: expected an object of a subclass of ReachAvoidProblem, got {problem!r}")
    run = RunDirectory(folder)
    config = load_config(folder)
    config.device = device
    if config.get("grid") is not None:
        problem = make_problem(config, trust) if problem is None else problem
        # It has the methods of a solution that a run needs.
        return Run(cast(Solution, GridSolution.load(run.grid, problem)), config, 0, trust)
    path = run.newest() if weights is None else run.checkpoint(weights)
    state = checkpoint.load(path)
    problem = make_problem(config, trust) if problem is None else problem
    actor, critics = make_networks(config, problem, trust)
    critic = stack(critics)
    for network, entries in zip((actor, critic), checkpoint.network_states(state), strict=True):
        with fitting(path):
            check_module(entries, network.state_dict())
        network.load_state_dict(entries)
    return Run(Solution(problem, actor, critic), config, int(state["update"]), trust)
