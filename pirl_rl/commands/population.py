"""Train a population, `python -m pirl_rl.train +experiment=reach1d trainer.seeds=[0,1,2]`, see `pirl_rl.population`.

The directory of a population has one run directory for each member, named as those of a sweep, and the means of the
members' metrics as its summary.
"""

from __future__ import annotations

import contextlib
import copy
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from pirl_rl import checkpoint
from pirl_rl.assembly import choose
from pirl_rl.building import convert
from pirl_rl.commands.directory import begin, new_directory, reopen, show
from pirl_rl.configuration import load_config, save_config
from pirl_rl.errors import ConfigError, DivergenceError
from pirl_rl.files import replacing
from pirl_rl.lock import locked
from pirl_rl.population import Population
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.run_directory import RunDirectory
from pirl_rl.trainer import Trainer

SEEDS = "trainer.seeds"

VARIED: dict[str, type] = {
    "schedule.center": float,
    "schedule.steepness": float,
    "schedule.initial": list,
    "schedule.final": list,
    "learner.learning_rate": float,
}
"""The settings, beside the seed, in which members may differ, with the type of one value."""


def train_population(
    config: DictConfig, folder: Path, overrides: Sequence[str], trust: Sequence[str], problem: ReachAvoidProblem
) -> dict[str, float]:
    """Train the members of a configuration with `trainer.seeds`; returns the means of their summaries.

    Args:
        config: the configuration of the population.
        folder: its directory, which exists.
        overrides: the overrides of the user, which are recorded.
        trust: modules outside the package that the configuration may name.
        problem: the problem.

    Raises:
        PirlError: if a configuration cannot be built, or training is interrupted.
        DivergenceError: if the training of a member has diverged; the others are complete.
    """
    if config.grid is not None:
        raise ConfigError(f"{SEEDS}: expected null with method=grid, which draws no random numbers")
    _members(config)  # refuses wrong lists before anything is written
    choose(config, problem)  # once for all members
    # The configuration comes before the members, so that a population that is killed between them can be resumed.
    OmegaConf.save(list(overrides), RunDirectory(folder).overrides)
    save_config(config, folder)
    return _train(config, folder, overrides, trust, problem)


def resume_population(
    config: DictConfig,
    folder: Path,
    overrides: Sequence[str],
    trust: Sequence[str],
    problem: ReachAvoidProblem | None = None,
) -> dict[str, float]:
    """Resume a population from the checkpoints of its members; returns the means of their summaries.

    Members that a kill has left without a configuration begin.

    Raises:
        PirlError: as `train_population`, or if settings are to be changed.
    """
    if changed := [text for text in overrides if not text.startswith("trust=")]:
        raise ConfigError(
            f"{changed[0]}: expected no other settings for a population; a member alone can be resumed with them"
        )
    typed = [str(text) for text in OmegaConf.load(RunDirectory(folder).overrides)]
    return _train(config, folder, typed, trust, problem)


def member_names(config: DictConfig) -> list[str]:
    """The names of the run directories of the members of a population, in its directory."""
    return [f"{index}-{config.method_name}-{seed}" for index, seed in enumerate(config.trainer.seeds)]


def _members(config: DictConfig) -> list[dict[str, Any]]:
    """The settings in which the members of a population differ, by their keys.

    `trainer.seeds` has one seed for each member. A setting of `VARIED` that is a list has one value for each, too.

    Raises:
        ConfigError: for a list of another length, or with a value of another type.
    """
    seeds = config.trainer.seeds
    if not isinstance(seeds, ListConfig) or not seeds or (len({*seeds}) != len(seeds) and not _lists(config)):
        raise ConfigError(f"{SEEDS}: expected a list of different seeds, one for each member, got {seeds}")
    columns: dict[str, list[Any]] = {"seed": [convert(seed, int, SEEDS) for seed in seeds]}
    for key, values in _lists(config).items():
        if len(values) != len(seeds):
            raise ConfigError(f"{key}: expected {len(seeds)} values, one for each of {SEEDS}, got {len(values)}")
        columns[key] = [convert(value, VARIED[key], key) for value in values]
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _lists(config: DictConfig) -> dict[str, list[Any]]:
    """The settings of `VARIED` that have a value for each member."""
    found = {}
    for key, kind in VARIED.items():
        value = OmegaConf.select(config, key)
        if isinstance(value, ListConfig) and (
            kind is not list or all(isinstance(entry, ListConfig) for entry in value)
        ):
            found[key] = OmegaConf.to_container(value)
    return found


def _member_config(config: DictConfig, own: dict[str, Any]) -> DictConfig:
    """The configuration of a member, which is that of a run of its own."""
    config = copy.deepcopy(config)
    config.trainer.seeds = None
    for key, value in own.items():
        OmegaConf.update(config, key, value)
    return config


def _typed(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


def _train(
    config: DictConfig,
    folder: Path,
    overrides: Sequence[str],
    trust: Sequence[str],
    problem: ReachAvoidProblem | None,
) -> dict[str, float]:
    """Begin the members, or reopen those that were begun, and train them; arguments are those of `train_population`."""
    trainers, numbers, configs = [], [], []
    with contextlib.ExitStack() as stack:
        for name, own in zip(member_names(config), _members(config), strict=True):
            path = folder / name
            if RunDirectory(path).config.exists():
                stack.enter_context(locked(RunDirectory(path)))
                configs.append(load_config(path))
                trainers.append(reopen(configs[-1], path, [f"resume={folder.name}"], trust, problem))
            else:
                stack.enter_context(new_directory(path))
                typed = [text for text in overrides if text.partition("=")[0].lstrip("+") not in (SEEDS, *own)]
                typed += [f"{key}={_typed(value)}" for key, value in own.items()]
                configs.append(_member_config(config, own))
                trainers.append(begin(configs[-1], path, typed, trust, problem))
            numbers.append(checkpoint.global_rng_states())
        return _finish(Population(trainers, numbers), configs, folder, trust)


def _finish(
    population: Population, configs: Sequence[DictConfig], folder: Path, trust: Sequence[str]
) -> dict[str, float]:
    summaries = population.train()
    members: list[Trainer] = list(population.members)
    for config, member, summary in zip(configs, members, summaries, strict=True):
        if summary is not None:
            print(f"\nmember   {member.folder}", flush=True)
            show(member, summary, config, trust)
    complete = [summary for summary in summaries if summary is not None]
    means = {name: _mean([one.get(name, math.nan) for one in complete]) for name in complete[0]} if complete else {}
    if errors := population.errors:
        lines = "; ".join(f"{members[index].folder}: {error}" for index, error in errors.items())
        raise DivergenceError(f"{len(errors)} of {len(members)} members ended before the last update: {lines}")
    with replacing(RunDirectory(folder).summary) as file:
        file.write(json.dumps({"members": len(complete)} | means, indent=2) + "\n")
    print(f"\npopulation of {len(complete)}, with the means of its members' metrics: {RunDirectory(folder).summary}")
    return means


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
