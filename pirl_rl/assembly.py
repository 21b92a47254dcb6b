"""Assembly of a trainer and its parts from a configuration, and their restoration from a checkpoint."""

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
    """The device of a name; "auto" is CUDA if it is available, else the CPU.

    Raises:
        ConfigError: for an unknown name, or "cuda" without a CUDA device.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device: expected auto, cpu or cuda, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device: expected a CUDA device for device=cuda, got none; use device=cpu or auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def make_networks(
    config: DictConfig, problem: ReachAvoidProblem, trust: Sequence[str] = ()
) -> tuple[Actor, list[Critic]]:
    """New networks, the actor and the critics, on the configuration's device."""
    device = pick_device(config.device)
    actor = build(config.actor, "actor", trust, problem=problem).to(device)
    count = convert(config.critics, Literal[1, 2], "critics")
    return actor, [build(config.critic, "critic", trust, problem=problem).to(device) for _ in range(count)]


def make_simulator(config: DictConfig, problem: ReachAvoidProblem) -> Simulator:
    """The simulator of the training environment."""
    steps = {name: config.env[name] for name in ("dt", "substeps", "crossing") if name in config.env}
    return Simulator(problem, **steps)


def make_problem(config: DictConfig, trust: Sequence[str] = ()) -> ReachAvoidProblem:
    """The problem that a configuration names.

    Raises:
        ConfigError: if it names none, for example because the run was trained on an object of Python code.
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
    """Build the trainer of a configuration with all its parts; nothing is written yet.

    Args:
        config: the configuration of a run.
        folder: the run directory; None keeps everything in memory.
        trust: modules outside the package that the configuration may name.
        problem: replaces `env.problem`.

    Raises:
        ConfigError: with the key, what was expected and what was got.
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
        # TorchRL warns that the loss has no updater of the target networks, which the learner creates later.
        warnings.filterwarnings("ignore", message="No target network updater")
        # The networks were moved to their device before, so that the loss shares their buffers.
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
    """The settings of the environment without the problem, in a copy of the configuration, to whose keys they refer."""
    others = copy.deepcopy(config)
    with open_dict(others):
        others.env.pop("problem", None)
    return others.env


def _make_stage(node: DictConfig, key: str, trust: Sequence[str], parts: Mapping[str, Any]) -> Stage:
    stage = OmegaConf.create({"_target_": f"{Stage.__module__}.{Stage.__qualname__}", **node})
    return build(stage, key, trust, parts)


def make_evaluation_simulator(config: DictConfig, problem: ReachAvoidProblem) -> Simulator:
    """The simulator of the evaluators."""
    return build(config.evaluation.simulator, "evaluation.simulator", problem=problem)


def make_evaluators(config: DictConfig, when: str, trust: Sequence[str]) -> dict[str, Evaluator]:
    """The evaluators of one of the lists "during" and "final" of the node `evaluation`, by name.

    Args:
        config: the node `evaluation`.
        when: name of the list.
        trust: modules outside the package that the node may name.

    Raises:
        ConfigError: if an entry of the list is not the name of an evaluator, or an evaluator cannot be built.
    """
    names = config[when]
    nodes = [str(name) for name in config if isinstance(config[name], DictConfig)]
    known = [name for name in nodes if name != "simulator"]
    if not isinstance(names, ListConfig) or not all(name in known for name in names):
        raise ConfigError(f"evaluation.{when}: expected a list of names out of {', '.join(known)}, got {names}")
    return {name: build(config[name], f"evaluation.{name}", trust) for name in names}


def restore(trainer: Trainer) -> None:
    """Restore the state of a trainer from the last checkpoint of its run directory.

    Raises:
        CheckpointError: if the checkpoint is missing, broken or of another configuration.
        ConfigError: if the run has already made more than `trainer.updates` updates.
    """
    assert trainer.folder is not None
    path = RunDirectory(trainer.folder).last
    state = checkpoint.load(path)
    with fitting(path):
        expected = trainer.state_dict()
        if state.get("rollback") is None:
            del expected["rollback"]  # a resumed run may switch the guard on
        _check_learner(state, expected.pop("learner"))
        check_entries(state, expected)
    trainer.load_state_dict(state)
    if trainer.update > trainer.updates:
        message = f"expected at least {trainer.update}, which {trainer.folder} has made, got {trainer.updates}"
        raise ConfigError(f"trainer.updates: {message}")


def start_from(trainer: Trainer, start: str) -> Path:
    """Load the networks and target networks of another run into a new trainer.

    A `last.pt` also gives the optimisers and the transitions of the replay buffer, except after a collapse: those
    transitions were played by the collapsed policy.

    Args:
        trainer: the new trainer, which keeps its seeds and counts its updates from 0.
        start: a run directory, whose newest checkpoint is taken, or a file in its `checkpoints/`.

    Returns:
        The absolute path of the checkpoint.

    Raises:
        CheckpointError: if the checkpoint is missing, broken or of another configuration.
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
    others = {name: entry for name, entry in expected.items() if name != "loss"}
    check_entries(state, {"learner": others})
    check_module(state["learner"]["loss"], expected["loss"])


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Turn the refusal of an argument, while a checkpoint is checked or loaded, into an error that names the file.

    Raises:
        CheckpointError: if the block raises an ArgumentError.
    """
    try:
        yield
    except ArgumentError as error:
        raise CheckpointError(f"{path} does not fit the run's configuration: {error}") from error
