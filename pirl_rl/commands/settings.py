"""Settings that are Python arguments: their translation to overrides of Hydra, and the composed configuration."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from os import PathLike, fspath
from typing import Any

import numpy as np
from hydra.errors import HydraException
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.commands.composition import compose
from pirl_rl.configuration import CONF
from pirl_rl.errors import ConfigError
from pirl_rl.outer_loop.candidates import quoted

WORD = re.compile(r"(?!(?:null|true|false|inf|nan|on|off|yes|no)$)[A-Za-z_][\w./-]*", re.IGNORECASE)
"""Text that Hydra reads as a string without quotes."""


def compose_run(experiment: str, settings: Mapping[str, Any]) -> tuple[DictConfig, list[str]]:
    """Compose the configuration of a new run.

    Args:
        experiment: name of the experiment.
        settings: values by keys with dots, nested mappings, choices of groups, or arguments of the trainer.

    Returns:
        The configuration, with the settings of Hydra under `hydra`, and the overrides of an equal command line.

    Raises:
        ConfigError: for an unknown name or choice, or a value that no configuration can hold.
    """
    groups = {path.name for path in CONF.iterdir() if path.is_dir()}
    try:
        chosen = {name: value for name, value in settings.items() if name in groups and isinstance(value, str)}
        typed = [f"+experiment={experiment}"]
        config = compose("train", typed, with_hydra=True)
        listed = config.hydra.runtime.choices
        typed += [f"{name if name in listed else f'+{name}'}={value}" for name, value in chosen.items()]
        if chosen:
            config = compose("train", typed, with_hydra=True)
        run_folder(config)  # takes out Hydra's own settings, which are no settings of a run
        others = {name: value for name, value in settings.items() if name not in chosen}
        typed += typed_settings(others, config, "trainer", groups)
        return compose("train", typed, with_hydra=True), typed
    except HydraException as error:
        raise ConfigError(str(error)) from error
    except OmegaConfBaseException as error:
        raise ConfigError(f"{error.full_key}: {str(error.msg).partition(chr(10))[0]}") from error


def run_folder(config: DictConfig) -> str:
    """The run directory that Hydra's command line would choose; removes `hydra` from the configuration."""
    folder = config.hydra.run.dir
    with open_dict(config):
        del config["hydra"]
    return folder


def typed_settings(
    settings: Mapping[str, Any], config: DictConfig, short: str, groups: Sequence[str] | set[str] = ()
) -> list[str]:
    """Translate settings to overrides `key=value`.

    Args:
        settings: values by keys with dots, or nested mappings. A key with a plus sign in front, as of an argument that
            the configuration leaves at its default, is added.
        config: the configuration, which must have each other key unless a new `_target_` is set beside it.
        short: the node whose entries may be named without its name, such as "trainer".
        groups: names of groups, which the error message lists too.

    Raises:
        ConfigError: for an unknown key; the message lists the known ones.
    """
    texts = []
    renewed = tuple(name.removesuffix("_target_") for name in settings if name.endswith("._target_"))
    for name, value in settings.items():
        plain = name.lstrip("+")
        first, signs = plain.partition(".")[0], name.removesuffix(plain)
        if first in config.keys():
            key = name
        elif first in config[short].keys():
            key = f"{signs}{short}.{plain}"
        else:
            known = sorted({*map(str, config), *(str(key) for key in config[short] if key != "_target_"), *groups})
            raise ConfigError(f"{name}: expected one of {', '.join(known)}")
        texts += _texts(key, value, config, () if key.endswith("._target_") else renewed)
    return texts


def _texts(key: str, value: Any, config: DictConfig, renewed: tuple[str, ...]) -> list[str]:
    """The override of a setting or, for a mapping, those of its entries.

    Keys need not be in `config` if they begin with a plus sign, or with one of `renewed`, the nodes with a new
    `_target_`.
    """
    if key.startswith("+"):
        return [f"{key}={_literal(value, key)}"]
    if isinstance(value, Mapping):
        renewed = (*renewed, f"{key}.") if "_target_" in value else renewed
        return [text for name, entry in value.items() for text in _texts(f"{key}.{name}", entry, config, renewed)]
    free = key.startswith(renewed)
    if not free:
        _check_key(key, config)
    return [f"{'++' if free else ''}{key}={_literal(value, key)}"]


def _check_key(key: str, config: DictConfig) -> None:
    """Refuse a key that the configuration does not have.

    Raises:
        ConfigError: with the unknown part of the key and the names that are known in its place.
    """
    node: Any = config
    for count, part in enumerate(parts := key.split("."), 1):
        if not isinstance(node, DictConfig) or part not in node.keys():  # `in node` is False for a missing value
            known = ", ".join(str(name) for name in node) if isinstance(node, DictConfig) else "no more names"
            if isinstance(node, DictConfig) and "_target_" in node:
                known += f"; '+{key}' adds an argument to {node._target_}"
            raise ConfigError(f"{'.'.join(parts[:count])}: expected one of {known}")
        node = node._get_node(part)


def _literal(value: Any, key: str) -> str:
    """Write a value in the grammar of Hydra's overrides."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (str, PathLike)):
        text = str(fspath(value))
        return text if WORD.fullmatch(text) else quoted(text)
    if isinstance(value, Mapping):
        return f"{{{','.join(f'{name}:{_literal(entry, key)}' for name, entry in value.items())}}}"
    if isinstance(value, (Sequence, np.ndarray)):
        return f"[{','.join(_literal(entry, key) for entry in value)}]"
    raise ConfigError(f"{key}: expected a number, text, a list or a mapping of these, got {type(value).__name__}")
