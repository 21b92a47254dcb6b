"""The settings of `python -m pirl_rl.tune`: which belong to the loop, and which to the training of its candidates."""

from __future__ import annotations

from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig

from pirl_rl.building import convert
from pirl_rl.commands.start import method_of
from pirl_rl.errors import ConfigError
from pirl_rl.outer_loop.candidates import quoted

COUNTS = {"rounds": 1, "extra_rounds": 0, "candidates": 1, "updates": 1, "parallel": 1}
"""Settings of the loop that are integers, with the smallest value of each."""

OWN = ("start", "out", "advisor", "population", *COUNTS)
"""Settings of the loop; all others belong to the training of its candidates."""

PLANNED = ("schedule", "stages", "resume", "trainer.updates", "evaluation.final")
"""Settings that the loop sets for each candidate, so that they are refused on the command line."""

EVALUATIONS = 10
"""Smallest number of evaluations during a candidate's training. The guard detects a collapse at evaluations only."""


def counts_of(config: DictConfig) -> dict[str, int]:
    """The settings of the loop that are integers, by name.

    Raises:
        ConfigError: one of them is not an integer, or too small.
    """
    return {name: _count(config, name) for name in COUNTS}


def overrides_of_training(config: DictConfig, typed: Sequence[str]) -> list[str]:
    """The overrides of the training of every candidate.

    Args:
        config: the configuration of the loop.
        typed: the overrides on the command line.

    Raises:
        ConfigError: for a setting that the loop sets for each candidate.
    """
    return [*_method(config, typed), *_for_training(typed), *_frequent_evaluation(config)]


def readable(argument: str) -> str:
    """Quote the value of `advisor.command` for Hydra, since the shell has removed the user's quotes."""
    key, _, line = argument.partition("=")
    if key.lstrip("+") != "advisor.command":
        return argument
    try:
        OverridesParser.create().parse_override(argument)
    except HydraException:
        return f"{key}={quoted(line)}"
    return argument


def _count(config: DictConfig, name: str) -> int:
    value = convert(config[name], int, name)
    if not isinstance(value, int) or value < COUNTS[name]:
        raise ConfigError(f"{name}: expected an integer >= {COUNTS[name]}, got {value!r}")
    return value


def _for_training(typed: Sequence[str]) -> list[str]:
    """The overrides on the command line that belong to the training of every candidate.

    Raises:
        ConfigError: for a setting that the loop sets for each candidate.
    """
    parser, kept = OverridesParser.create(), []
    for text in typed:
        key = parser.parse_override(text).key_or_group
        if any(_within(key, name) for name in PLANNED):
            raise ConfigError(f"{text}: expected no {key} here, the loop sets it for every candidate")
        if not any(_within(key, name) for name in OWN):
            kept.append(text)
    return kept


def _frequent_evaluation(config: DictConfig) -> list[str]:
    """An override for experiments that are made for longer runs, with at least `EVALUATIONS` evaluations."""
    every, most = config.trainer.evaluate_every, max(1, config.updates // EVALUATIONS)
    return [f"trainer.evaluate_every={most}"] if isinstance(every, int) and every > most else []


def _method(config: DictConfig, typed: Sequence[str]) -> list[str]:
    """An override for the method of the start, whose networks the candidates continue, unless another one was typed."""
    if any(text.partition("=")[0].lstrip("+") == "method" for text in typed) or not isinstance(config.start, str):
        return []
    method = method_of(config.start)
    return [] if method in (None, config.method_name) else [f"method={method}"]


def _within(key: str, name: str) -> bool:
    return key == name or key.startswith(f"{name}.")
