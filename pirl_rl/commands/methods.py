"""What a method owns: the settings that `conf/method/<name>.yaml` states, which no experiment may change in silence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pirl_rl.configuration import CONF
from pirl_rl.errors import ConfigError

NO_SETTINGS = ("defaults", "method_name")


def check_method(config: DictConfig, typed: Sequence[str]) -> None:
    """Refuse an experiment that is not made for the chosen method, or that changes what the method owns.

    Args:
        config: as composed, references unresolved.
        typed: the overrides that were typed; what a person types is on purpose.

    Raises:
        ConfigError: with the method, and the experiments for which it works or the setting that was changed.
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
    """The settings of a method with their keys; what it leaves to experiments, under its own name, is none of them.

    Args:
        method: name of a file of `conf/method`; a method from elsewhere owns nothing.
    """
    path = CONF / "method" / f"{method}.yaml"
    if not path.is_file():
        return []
    settings = _settings(path)
    blocks = [entry.stem for entry in path.parent.glob("*.yaml")]
    return [(key, value) for key, value in _leaves(settings) if key.partition(".")[0] not in (*NO_SETTINGS, *blocks)]


def _settings(path: Path) -> dict[str, Any]:
    """A method's file over those that it starts from."""
    own = OmegaConf.load(path)
    assert isinstance(own, DictConfig)
    bases = [name for name in own.get("defaults", []) if name != "_self_"]
    merged = OmegaConf.merge(*(OmegaConf.create(_settings(path.with_stem(name))) for name in bases), own)
    return OmegaConf.to_container(merged, resolve=False)  # type: ignore[return-value]


def _leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict) and node:
        for name, value in node.items():
            yield from _leaves(value, f"{key}.{name}".lstrip("."))
    else:
        yield key, node
