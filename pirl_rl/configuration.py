"""Where configurations lie: the folder of the package's own, and the file of a run directory."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.errors import ConfigError
from pirl_rl.files import replacing
from pirl_rl.renames import upgraded
from pirl_rl.run_directory import FORMAT, RunDirectory

PACKAGE = Path(__file__).resolve().parent
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"
"""The folder of the configuration, inside an installed package or beside it in a checkout."""

REFERENCE = re.compile(r"\$\{[\w.]+\}")
"""A reference to another key of the configuration."""


def load_config(folder: str | PathLike[str]) -> DictConfig:
    """The configuration of a run directory, converted to the current format.

    It may refer to its own keys, as in `${env.dt}`, but call no resolver: `${oc.env:TOKEN}` would read a secret of the
    user.

    Raises:
        ConfigError: if the folder is not a run directory, or its configuration cannot be read, calls a resolver or is
            of a later format.
    """
    path = RunDirectory(folder).config
    if not path.is_file():
        raise ConfigError(f"{folder} is not a run directory: expected {path}")
    try:
        config = OmegaConf.load(path)
        if not isinstance(config, DictConfig):
            raise ConfigError(f"{path}: expected a mapping, got {type(config).__name__}")
        if not config:
            raise ConfigError(f"{path}: expected the settings of a run, got an empty file")
        raw = OmegaConf.to_container(config, resolve=False)
        _refuse_resolvers(raw, str(path))
        written_in = config.pop("format", 1)
        if written_in == 1:
            config = _upgraded(config, raw)
        elif written_in != FORMAT:
            raise ConfigError(
                f"{path}: expected format 1 to {FORMAT}, got {written_in}, which a later version of pirl_rl writes"
            )
    except (yaml.YAMLError, UnicodeDecodeError, OmegaConfBaseException, OSError) as error:
        raise ConfigError(f"{path} is not readable: {str(error).partition(chr(10))[0]}") from None
    OmegaConf.set_struct(config, True)
    return config


def _upgraded(config: DictConfig, raw: Any) -> DictConfig:
    """Convert a configuration of format 1 to the current one; references between keys that both have are kept."""
    new = OmegaConf.create(upgraded(OmegaConf.to_container(config, resolve=True)))  # type: ignore[arg-type]
    for key, reference in _references(raw):
        values = [OmegaConf.select(new, name) for name in (key, reference[2:-1])]
        if values[0] is not None and values[0] == values[1]:
            OmegaConf.update(new, key, reference)
    return new


def _references(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """All pairs (key, "${other.key}") of nested mappings."""
    for name, inner in value.items():
        if isinstance(inner, dict):
            yield from _references(inner, f"{key}{name}.")
        elif isinstance(inner, str) and REFERENCE.fullmatch(inner):
            yield f"{key}{name}", inner


def _refuse_resolvers(value: Any, key: str) -> None:
    if isinstance(value, (dict, list)):
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            _refuse_resolvers(inner, f"{key}: {name}")
    elif isinstance(value, str) and "${" in REFERENCE.sub("", value):
        raise ConfigError(f"{key}: a run directory may refer to its own keys only, got {value}; write the value itself")


def _concrete(node: Any, raw: Any) -> None:
    """Replace what `_refuse_resolvers` refuses, as a value from the environment, by its value."""
    for name, inner in raw.items() if isinstance(raw, dict) else enumerate(raw):
        if isinstance(inner, (dict, list)):
            _concrete(node[name], inner)
        elif isinstance(inner, str) and "${" in REFERENCE.sub("", inner):
            node[name] = node[name]


def save_config(config: DictConfig, folder: str | Path) -> None:
    """Write the configuration of a run directory for `load_config`, with references to its own keys alone."""
    config = copy.deepcopy(config)
    _concrete(config, OmegaConf.to_container(config, resolve=False))
    with replacing(RunDirectory(folder).config) as file:
        file.write(f"format: {FORMAT}\n{OmegaConf.to_yaml(config)}")
