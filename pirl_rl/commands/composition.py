"""Composition: the configuration of a run, put together by Hydra from `conf/` and from what is typed.

A node of `conf/` that starts from `/arguments/<class>@...` has every argument of that class's constructor as a key,
with the constructor's default: a value stands in one place, and plain `key=value` reaches it.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from functools import cache
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import MISSING, DictConfig, OmegaConf, open_dict

from pirl_rl.configuration import CONF, parameters_of, resolve

REFERENCE = re.compile(r"^\s*- /arguments/([\w.]+)@", re.MULTILINE)

SUPPLIED = frozenset(
    [
        *("problem", "simulator", "env", "actor", "critics", "loss", "learner", "collector", "collocation", "boundary"),
        *("schedule", "stages", "during", "final", "logger", "folder", "config", "device"),
        *("td_weight", "hjb_weight", "boundary_weight"),
    ]
)
"""Constructor arguments that `pirl_rl.assembly` supplies, or that the schedule moves: no configuration holds them."""

SEEDED = frozenset(("device", "env", "learner"))
"""A constructor with one of these arguments gets its `seed` from the run's."""


def arguments(target: str) -> dict[str, Any]:
    """A configuration node of a class: each argument with its default, or as missing where it has none."""
    constructor = resolve(target, target)
    parameters = parameters_of(constructor)
    left_out = SUPPLIED | ({"seed"} if SEEDED & parameters.keys() else set())
    defaults = {name: entry.default for name, entry in parameters.items() if name not in left_out}
    values = {name: MISSING if value is inspect.Parameter.empty else value for name, value in defaults.items()}
    plain = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
    return {"_target_": target, **plain}


@cache
def register() -> None:
    """Make known to Hydra the constructors that `conf/` refers to."""
    store = ConfigStore.instance()
    for path in sorted(CONF.rglob("*.yaml")):
        for target in REFERENCE.findall(path.read_text(encoding="utf-8")):
            store.store(target, arguments(target), group="arguments")


def drop_leftovers(config: DictConfig, typed: Sequence[str], trust: Sequence[str]) -> None:
    """Take out of a node whose `_target_` was typed the arguments of the class that stood there before.

    Args:
        config: as composed; changed in place.
        typed: the overrides that were typed.
        trust: modules outside the package that they name.

    Raises:
        ConfigError: a target that cannot be loaded.
    """
    keys = {text.partition("=")[0].lstrip("+~") for text in typed}
    for key in (name for name in keys if name.endswith("._target_")):
        node = OmegaConf.select(config, key.removesuffix("._target_"))
        parameters = parameters_of(resolve(node._target_, key, trust))
        if any(entry.kind is entry.VAR_KEYWORD for entry in parameters.values()):
            continue
        with open_dict(node):
            for name in [str(name) for name in node if name != "_target_" and name not in parameters]:
                if f"{key.removesuffix('_target_')}{name}" not in keys:
                    del node[name]


def compose(name: str, overrides: Sequence[str], with_hydra: bool = False) -> DictConfig:
    """A configuration from one of the primary files of `conf/`, "train" or "tune", and typed overrides.

    A Hydra that is at work already, as around a command or a script of the user's, is back afterwards.

    Args:
        name: of the primary file.
        overrides: `key=value`, as on a command line.
        with_hydra: whether the configuration keeps Hydra's own settings, under `hydra`.
    """
    register()
    active = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            return hydra.compose(name, list(overrides), return_hydra_config=with_hydra)
    finally:
        GlobalHydra.instance().clear()
        if active is not None:
            GlobalHydra.instance().initialize(active)
