"""Composition of a configuration by Hydra, from `conf/` and the overrides on the command line.

A node of `conf/` that starts from `/arguments/<class>@...` has every argument of that class's constructor as a key,
with the constructor's default. So a default is written in one place, and a plain `key=value` can override it.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import MISSING, DictConfig, OmegaConf, open_dict

from pirl_rl.building import parameters_of, resolve
from pirl_rl.configuration import CONF
from pirl_rl.errors import ConfigError

OTHER_FOLDERS = ("-cd", "-cp", "--config-dir", "--config-path", "hydra.searchpath")
"""Settings of Hydra that add folders with choices of one's own to those of `conf/`."""

REFERENCE = re.compile(r"^\s*- /arguments/([\w.]+)@", re.MULTILINE)

SUPPLIED = frozenset(
    [
        *(
            "problem",
            "simulator",
            "solution",
            "env",
            "actor",
            "critics",
            "loss",
            "learner",
            "collector",
            "collocation",
            "boundary",
        ),
        *(
            "schedule",
            "stages",
            "during",
            "final",
            "logger",
            "folder",
            "config",
            "device",
            "compile",
            "compile_simulator",
        ),
        *("td_weight", "hjb_weight", "boundary_weight"),
    ]
)
"""Constructor arguments that no configuration holds: `pirl_rl.assembly` supplies them, or the schedule sets them."""

SEEDED = frozenset(("device", "env", "learner"))
"""A constructor with one of these arguments gets its `seed` from `pirl_rl.assembly` too."""


def arguments(target: str) -> dict[str, Any]:
    """The configuration node of a class: each constructor argument with its default, or as missing if it has none."""
    constructor = resolve(target, target)
    parameters = parameters_of(constructor)
    left_out = SUPPLIED | ({"seed"} if SEEDED & parameters.keys() else set())
    defaults = {name: entry.default for name, entry in parameters.items() if name not in left_out}
    values = {name: MISSING if value is inspect.Parameter.empty else value for name, value in defaults.items()}
    plain = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
    return {"_target_": target, **plain}


@cache
def register() -> None:
    """Register the nodes of all constructors that `conf/` refers to with Hydra."""
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


def check_overrides(texts: Sequence[str]) -> None:
    """Refuse overrides that cannot be read, and unknown choices of a group of `conf/`, in one sentence.

    Args:
        texts: overrides `key=value`; flags of Hydra among them are skipped.

    Raises:
        ConfigError: with the override, or with the choices of its group.
        YAMLError: a chosen file in the user's own folder cannot be read; the message names the file and the line.
    """
    parser, folder = OverridesParser.create(), _users_folder(texts)
    for text in texts:
        if text.startswith("-") or "=" not in text:
            continue
        try:
            override = parser.parse_override(text)
        except HydraException as error:
            reason = str(error).partition("\n")[0]
            raise ConfigError(f"{text}: expected key=value in the grammar of Hydra ({reason})") from None
        key, chosen = override.key_or_group, None if override.is_sweep_override() else override.value()
        if not key:
            raise ConfigError(f"{text}: expected key=value, got no key")
        if folder is not None and (own := folder / key / f"{chosen}.yaml").is_file():
            OmegaConf.load(own)  # Hydra would end with a traceback where the file is no YAML
        group = CONF / key
        if not (group.is_dir() and isinstance(chosen, str)) or any(text.startswith(OTHER_FOLDERS) for text in texts):
            continue
        if not (group / f"{chosen}.yaml").is_file():
            known = ", ".join(sorted(path.stem for path in group.glob("*.yaml")))
            raise ConfigError(f"{key}: expected one of {known}, got {chosen!r}")


def _users_folder(texts: Sequence[str]) -> Path | None:
    """The folder of the user's own choices, which Hydra takes as `--config-dir FOLDER` or `--config-dir=FOLDER`."""
    for flag, following in pairwise([*texts, ""]):
        name, _, folder = flag.partition("=")
        if name in ("-cd", "--config-dir"):
            return Path(folder or following)
    return None


def compose(name: str, overrides: Sequence[str], with_hydra: bool = False) -> DictConfig:
    """Compose a configuration from a primary file of `conf/` and overrides.

    An active Hydra, such as that of a command or of the user's script, is restored afterwards.

    Args:
        name: the primary file, "train" or "tune".
        overrides: overrides `key=value`, as on a command line.
        with_hydra: whether the configuration contains the settings of Hydra, under `hydra`.

    Raises:
        ConfigError: for an override that cannot be read, or an unknown choice of a group.
        HydraException: for an unknown key.
    """
    check_overrides(overrides)
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
