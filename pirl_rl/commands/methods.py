"""The settings of `conf/method/<name>.yaml`, which the method owns, and the check that no experiment changes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pirl_rl.configuration import CONF
from pirl_rl.errors import ConfigError

NO_SETTINGS = ("defaults", "method_name")
"""Keys of a method's file that are no settings."""


def check_method(config: DictConfig, typed: Sequence[str]) -> None:
    """Refuse an experiment that is not made for the chosen method, or that changes a setting of the method.

    Args:
        config: the composed configuration with unresolved references.
        typed: the overrides on the command line, which may change settings of the method.

    Raises:
        ConfigError: with the methods of the experiment, or with the setting that it would change.
    """
    method, experiment = config.method_name, config.experiment_name
    if config.methods is not None and method not in config.methods:
        raise ConfigError(
            f"method: the experiment {experiment} is made for method={' or '.join(config.methods)}, got {method}"
        )
    keys = [text.partition("=")[0].lstrip("+~") for text in typed]
    composed = dict(_leaves(OmegaConf.to_container(config, resolve=False)))
    for key, value in owned(method):
        if composed.get(key) == value or any(key == name or key.startswith(f"{name}.") for name in keys):
            continue
        raise ConfigError(
            f"{key}: the method {method} sets {value}, and the experiment {experiment} would change it to "
            f"{composed.get(key)}; expected another method, or {key}=... on the command line"
        )


def owned(method: str) -> list[tuple[str, Any]]:
    """The settings that a method owns, as pairs of key and value.

    A block with the name of a method holds values that experiments may set, so its entries are not owned.

    Args:
        method: name of a file of `conf/method`; a method without a file there owns nothing.
    """
    path = CONF / "method" / f"{method}.yaml"
    if not path.is_file():
        return []
    settings = _settings(path)
    blocks = [entry.stem for entry in path.parent.glob("*.yaml")]
    return [(key, value) for key, value in _leaves(settings) if key.partition(".")[0] not in (*NO_SETTINGS, *blocks)]


def _settings(path: Path) -> dict[str, Any]:
    """The entries of a method's file, merged over those of the files in its defaults list."""
    own = OmegaConf.load(path)
    assert isinstance(own, DictConfig)
    bases = [name for name in own.get("defaults", []) if isinstance(name, str) and "/" not in name and name != "_self_"]
    merged = OmegaConf.merge(*(OmegaConf.create(_settings(path.with_stem(name))) for name in bases), own)
    return OmegaConf.to_container(merged, resolve=False)  # type: ignore[return-value]


def _leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict) and node:
        for name, value in node.items():
            yield from _leaves(value, f"{key}.{name}".lstrip("."))
    else:
        yield key, node
