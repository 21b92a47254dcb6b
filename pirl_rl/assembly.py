"""From a configuration to a trainer, and back to where a checkpoint left it."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict

from pirl_rl import checkpoint
from pirl_rl.checkpoint import check_entries, check_module
from pirl_rl.configuration import build, convert
from pirl_rl.curriculum import Stage
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.errors import ArgumentError, CheckpointError, ConfigError
from pirl_rl.evaluation import Evaluator
from pirl_rl.networks import Actor, Critic
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.run_directory import RunDirectory
from pirl_rl.simulator import Simulator
from pirl_rl.trainer import Trainer


def pick_device(name: str) -> torch.device:
    """ "auto" is CUDA where there is one.

    Raises:
        ConfigError: an unknown name, or CUDA where there is none.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device: expected auto, cpu or cuda, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device: expected a CUDA device for device=cuda, found none; use device=cpu or auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def make_networks(
    config: DictConfig, problem: ReachAvoidProblem, trust: Sequence[str] = ()
) -> tuple[Actor, list[Critic]]:
    """Fresh networks on the configuration's device: the actor and the critics."""
    device = pick_device(config.device)
    actor = build(config.actor, "actor", trust, problem=problem).to(device)
    count = convert(config.critics, Literal[1, 2], "critics")
    return actor, [build(config.critic, "critic", trust, problem=problem).to(device) for _ in range(count)]


def make_simulator(config: DictConfig, problem: ReachAvoidProblem) -> Simulator:
    """The simulator that the training environment plays."""
    steps = {name: config.env[name] for name in ("dt", "substeps", "crossing") if name in config.env}
    return Simulator(problem, **steps)


def make_problem(config: DictConfig, trust: Sequence[str] = ()) -> ReachAvoidProblem:
    """The problem that a configuration names.

    Raises:
        ConfigError: it names none, as that of a run on an object that only Python code has.
    """
    node = config.env.problem
    if isinstance(node, DictConfig) and OmegaConf.is_missing(node, "_target_"):
        raise ConfigError(
            "env.problem._target_: a value is missing, give env.problem._target_=my_module.MyProblem; a run that was "
            "trained on an object of Python code opens with load_run(folder, problem=...)"
        )
    return build(node, "env.problem", trust)


def make_trainer(
    config: DictConfig, folder: Path | None = None, trust: Sequence[str] = (), problem: ReachAvoidProblem | None = None
) -> Trainer:
    """Everything a configuration names, put together; nothing is written yet.

    Args:
        config: all settings.
        folder: the run directory; None keeps everything in memory.
        trust: modules outside the package that the configuration may name.
        problem: what is trained on in place of `env.problem`.

    Raises:
        ConfigError: naming the key, what was expected and what was got.
    """
    device = pick_device(config.device)
    seed = convert(config.seed, int, "seed")
    if seed < 0:
        raise ConfigError(f"seed: expected an integer >= 0, got {seed}")
    # Independent streams: the noise of the physics, the policy, sampling and collocation must not repeat each other.
    networks, physics, sampling, points = (int(word) for word in np.random.SeedSequence(seed).generate_state(4))
    torch.manual_seed(networks)
    problem = make_problem(config, trust) if problem is None else problem
    env: ReachAvoidEnv = build(_without_problem(config), "env", trust, problem=problem, seed=physics, device=device)
    parts = {"problem": problem, "simulator": env.simulator}
    actor, critics = make_networks(config, problem, trust)
    with warnings.catch_warnings():
        # The learner makes the updater of the target networks after the loss.
        warnings.filterwarnings("ignore", message="No target network updater")
        # The networks are on their device already: moving the loss alone would leave it buffers of its own.
        loss = build(config.loss, "loss", trust, parts, problem=problem, actor=actor, critics=critics).to(device)
    return build(
        config.trainer,
        "trainer",
        trust,
        learner=build(config.learner, "learner", trust, loss=loss),
        collector=build(config.collector, "collector", trust, env=env, actor=loss.actor_network.module, seed=sampling),
        collocation=build(config.collocation, "collocation", trust, parts),
        boundary=build(config.boundary, "boundary", trust, parts),
        schedule=build(config.schedule, "schedule", trust),
        stages=[_make_stage(node, f"stages[{i}]", trust, parts) for i, node in enumerate(config.stages)],
        during=make_evaluators(config.evaluation, "during", trust),
        final=make_evaluators(config.evaluation, "final", trust),
        simulator=make_evaluation_simulator(config, env.problem),
        logger=build(config.logger, "logger", trust),
        folder=folder,
        config=OmegaConf.to_container(config, resolve=True),
        seed=points,
    )


def _without_problem(config: DictConfig) -> DictConfig:
    """The environment's settings beside the problem, in a copy of all settings, to which they may refer."""
    others = copy.deepcopy(config)
    with open_dict(others):
        others.env.pop("problem", None)
    return others.env


def _make_stage(node: DictConfig, key: str, trust: Sequence[str], parts: Mapping[str, Any]) -> Stage:
    stage = OmegaConf.create({"_target_": f"{Stage.__module__}.{Stage.__qualname__}", **node})
    return build(stage, key, trust, parts)


def make_evaluation_simulator(config: DictConfig, problem: ReachAvoidProblem) -> Simulator:
    """The simulator that plays the paths of the evaluators."""
    return build(config.evaluation.simulator, "evaluation.simulator", problem=problem)


def make_evaluators(config: DictConfig, when: str, trust: Sequence[str]) -> dict[str, Evaluator]:
    """The evaluators of the list `when`, "during" or "final", of the node `evaluation`, by name."""
    names = config[when]
    nodes = [str(name) for name in config if isinstance(config[name], DictConfig)]
    known = [name for name in nodes if name != "simulator"]
    if not isinstance(names, ListConfig) or not all(name in known for name in names):
        raise ConfigError(f"evaluation.{when}: expected a list of names out of {', '.join(known)}, got {names}")
    return {name: build(config[name], f"evaluation.{name}", trust) for name in names}


def restore(trainer: Trainer) -> None:
    """Put a trainer where its run directory's last checkpoint left it.

    Raises:
        CheckpointError: none there, a broken one, or one of another configuration.
        ConfigError: the run is further than `trainer.updates` already.
    """
    assert trainer.folder is not None
    path = RunDirectory(trainer.folder).last
    state = checkpoint.load(path)
    with fitting(path):
        expected = trainer.state_dict()
        if state.get("rollback") is None:
            del expected["rollback"]  # the guard may watch from here on
        _check_learner(state, expected.pop("learner"))
        check_entries(state, expected)
    trainer.load_state_dict(state)
    if trainer.update > trainer.updates:
        raise ConfigError(f"trainer.updates: {trainer.folder} has done {trainer.update} already, got {trainer.updates}")


def start_from(trainer: Trainer, start: str) -> Path:
    """Give a new trainer the networks and targets of another run, and from a `last.pt` its optimisers and transitions.

    The transitions of a run that collapsed are those of spoilt networks: they stay behind.

    Args:
        trainer: fresh; keeps its own seeds and counts its own updates.
        start: a run directory, of which the newest checkpoint is taken, or a file of its `checkpoints/`.

    Returns:
        The checkpoint's file, absolute.

    Raises:
        CheckpointError: none there, a broken one, or one of another configuration.
    """
    path = RunDirectory(start).newest() if Path(start).is_dir() else Path(start)
    state = checkpoint.load(path)
    learner, buffer = trainer.learner, None
    with fitting(path):
        if "learner" in state:
            _check_learner(state, learner.state_dict())
            learner.load_state_dict(state["learner"])
        else:
            networks = checkpoint.loss_state(state)
            check_module(networks, learner.loss.state_dict())
            learner.loss.load_state_dict(networks)
        collapsed = (state.get("rollback") or {}).get("collapsed_at") is not None
        if "collector" in state and not collapsed:
            check_entries(state["collector"], {"buffer": {"transitions": {}, "writer": {}}}, "collector")
            buffer = state["collector"]["buffer"]
        trainer.collector.warm_start(buffer)
    learner.check_parameters(0)
    return path.absolute()


def _check_learner(state: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    rest = {name: entry for name, entry in expected.items() if name != "loss"}
    check_entries(state, {"learner": rest})
    check_module(state["learner"]["loss"], expected["loss"])


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """An argument that is refused while a checkpoint is checked and loaded becomes an error that names the file."""
    try:
        yield
    except ArgumentError as error:
        raise CheckpointError(f"{path} does not fit the run's configuration: {error}") from error
