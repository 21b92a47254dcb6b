"""Settings that are given in Python, as the overrides that Hydra's command line takes, and what they compose to."""

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
"""Text that Hydra reads as itself without quotes."""


def compose_run(experiment: str, settings: Mapping[str, Any]) -> tuple[DictConfig, list[str]]:
    """The configuration of a new run.

    Args:
        experiment: its name.
        settings: names with dots, nested mappings, choices of groups, or names of the trainer's arguments.

    Returns:
        The configuration, `hydra` included, and the same settings as a command line would have them.

    Raises:
        ConfigError: an unknown name or choice, or a value that no configuration can hold.
    """
    groups = {path.name for path in CONF.iterdir() if path.is_dir()}
    try:
        chosen = {name: value for name, value in settings.items() if name in groups and isinstance(value, str)}
        base = compose("train", [f"+experiment={experiment}"], with_hydra=True)
        listed = base.hydra.runtime.choices
        typed = [f"+experiment={experiment}"]
        typed += [f"{name if name in listed else f'+{name}'}={value}" for name, value in chosen.items()]
        rest = {name: value for name, value in settings.items() if name not in chosen}
        typed += typed_settings(rest, compose("train", typed), "trainer", groups)
        return compose("train", typed, with_hydra=True), typed
    except HydraException as error:
        raise ConfigError(str(error)) from error
    except OmegaConfBaseException as error:
        raise ConfigError(f"{error.full_key}: {str(error.msg).partition(chr(10))[0]}") from error


def run_folder(config: DictConfig) -> str:
    """Where Hydra's command line would put the run; takes `hydra` out of the configuration."""
    folder = config.hydra.run.dir
    with open_dict(config):
        del config["hydra"]
    return folder


def typed_settings(
    settings: Mapping[str, Any], config: DictConfig, short: str, groups: Sequence[str] | set[str] = ()
) -> list[str]:
    """Settings as overrides, `key=value`.

    Args:
        settings: names with dots, or nested mappings.
        config: where each of them has to be, unless a new `_target_` stands beside it.
        short: the node whose entries may be named without it.
        groups: further names, for the message alone.

    Raises:
        ConfigError: an unknown name, with those that are known.
    """
    texts = []
    for name, value in settings.items():
        first = name.partition(".")[0]
        if first in config.keys():
            key = name
        elif first in config[short].keys():
            key = f"{short}.{name}"
        else:
            known = sorted({*map(str, config), *(str(key) for key in config[short] if key != "_target_"), *groups})
            raise ConfigError(f"{name}: expected one of {', '.join(known)}")
        texts += _texts(key, value, config)
    return texts


def _texts(key: str, value: Any, config: DictConfig, free: bool = False) -> list[str]:
    """The overrides of one setting, those of its entries where it is a mapping."""
    if isinstance(value, Mapping):
        free = free or "_target_" in value
        return [text for name, entry in value.items() for text in _texts(f"{key}.{name}", entry, config, free)]
    if not free:
        _check(key, config)
    return [f"{'++' if free else ''}{key}={_literal(value, key)}"]


def _check(key: str, config: DictConfig) -> None:
    """
    Raises:
        ConfigError: naming the part of the key that the configuration does not have, and its neighbours.
    """
    node: Any = config
    for count, part in enumerate(parts := key.split("."), 1):
        if not isinstance(node, DictConfig) or part not in node.keys():  # even without a value
            known = ", ".join(str(name) for name in node) if isinstance(node, DictConfig) else "no more names"
            raise ConfigError(f"{'.'.join(parts[:count])}: expected one of {known}")
        node = node._get_node(part)


def _literal(value: Any, key: str) -> str:
    """A value as Hydra's grammar spells it."""
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
