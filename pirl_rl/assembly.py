"""Assembly of a trainer and its parts from a configuration."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict

from pirl_rl.automatic import (
    choose_actor,
    choose_paths,
    choose_playing,
    choose_probes,
    choose_residual_time,
    choose_time_steps,
    choose_updates,
)
from pirl_rl.building import build, convert
from pirl_rl.curriculum import Stage
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.errors import ConfigError
from pirl_rl.evaluation import Evaluator
from pirl_rl.evaluation.monte_carlo import paths_at_once
from pirl_rl.grid import GridSolver
from pirl_rl.networks import Actor, Critic
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates
from pirl_rl.schedules import WEIGHTS
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
    """New networks, the actor and the critics, on the configuration's device; `auto` in actor.* is replaced."""
    choose_actor(config, problem, trust)
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
            "trained on an object of Python code opens with load_run(folder, problem=...), and goes on with "
            "pirl_rl.train(problem, resume=folder)"
        )
    return build(node, "env.problem", trust)


def choose(config: DictConfig, problem: ReachAvoidProblem) -> str:
    """Replace the settings `auto` that depend on the problem; says why the trace is estimated, if it is."""
    choose_time_steps(config, problem)
    choose_playing(config, problem)
    choose_updates(config, problem)
    choose_paths(config, problem, make_evaluation_simulator(config, problem))
    choose_residual_time(config, problem)
    return choose_probes(config, problem)


def make_trainer(
    config: DictConfig, folder: Path | None = None, trust: Sequence[str] = (), problem: ReachAvoidProblem | None = None
) -> Trainer:
    """Build the trainer of a configuration with all its parts; nothing is written yet.

    Args:
        config: the configuration of a run; time steps and updates that are `auto` are replaced by the chosen numbers.
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
    reason = choose(config, problem)
    supplied = {"problem": problem, "seed": physics, "device": device, "compile_simulator": config.compile}
    env: ReachAvoidEnv = build(_without(config, "env", "problem"), "env", trust, **supplied)
    parts = {"problem": problem, "simulator": env.simulator}
    actor, critics = make_networks(config, problem, trust)
    with warnings.catch_warnings():
        # TorchRL warns that the loss has no updater of the target networks, which the learner creates later.
        warnings.filterwarnings("ignore", message="No target network updater")
        # The networks were moved to their device before, so that the loss shares their buffers.
        loss = build(config.loss, "loss", trust, parts, problem=problem, actor=actor, critics=critics).to(device)
    actor = loss.actor_network.module
    learned = parts | {"solution": loss.solution(), "others": env.initial_states, "compile": config.compile}
    if config.trainer.get("seeds") is not None:
        raise ConfigError(f"trainer.seeds: expected null for a single run, got {config.trainer.seeds}")
    trainer: Trainer = build(
        _without(config, "trainer", "seeds"),
        "trainer",
        trust,
        learner=build(config.learner, "learner", trust, loss=loss),
        collector=build(config.collector, "collector", trust, learned, env=env, actor=actor, seed=sampling),
        collocation=build(config.collocation, "collocation", trust, parts),
        boundary=build(config.boundary, "boundary", trust, parts),
        schedule=build(config.schedule, "schedule", trust),
        stages=[_make_stage(node, f"stages[{i}]", trust, learned) for i, node in enumerate(config.stages)],
        during=make_evaluators(config.evaluation, "during", trust),
        final=make_evaluators(config.evaluation, "final", trust),
        simulator=_share(make_evaluation_simulator(config, env.problem), env),
        logger=build(config.logger, "logger", trust),
        folder=folder,
        config=OmegaConf.to_container(config, resolve=True),
        seed=points,
    )
    if reason and trainer.curriculum.largest_weights()[WEIGHTS.index("hjb_weight")]:
        print(f"trace: {reason}", flush=True)
    return trainer


def _without(config: DictConfig, node: str, key: str) -> DictConfig:
    """A node of the configuration without a key, in a copy of the whole, to whose keys it may refer."""
    others = copy.deepcopy(config)
    with open_dict(others):
        others[node].pop(key, None)
    return others[node]


def _make_stage(node: DictConfig, key: str, trust: Sequence[str], parts: Mapping[str, Any]) -> Stage:
    stage = OmegaConf.create({"_target_": f"{Stage.__module__}.{Stage.__qualname__}", **node})
    return build(stage, key, trust, parts)


def make_grid_solver(config: DictConfig, problem: ReachAvoidProblem, trust: Sequence[str] = ()) -> GridSolver:
    """The grid solver of a configuration with method=grid."""
    return build(config.grid, "grid", trust, problem=problem)


def make_evaluation_simulator(config: DictConfig, problem: ReachAvoidProblem) -> Simulator:
    """The simulator of the evaluators."""
    # Functions that play many paths compile it, if anything is compiled at all.
    may_compile = None if config.get("compile", True) else False
    return build(config.evaluation.simulator, "evaluation.simulator", problem=problem, compile=may_compile)


def _share(simulator: Simulator, env: ReachAvoidEnv) -> Simulator:
    """Let a simulator of evaluators share the compiled one of the environment; returns the simulator.

    It does so if both have the same steps, and if the environment has as many paths as evaluators play at once, since
    a compiled simulator is made for one number of paths.
    """
    same = simulator.compile is None and simulator.compiled == env.simulator
    if same and env.batch_size[0] == paths_at_once(env.device):
        simulator.share(env.simulator)
    return simulator


def make_starts(config: DictConfig, trust: Sequence[str] = ()) -> InitialStates:
    """The law of starts of the evaluator `success`."""
    return build(config.evaluation.success, "evaluation.success", trust).initial_states


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
