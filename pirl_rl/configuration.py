"""From configuration nodes to objects: a node with `_target_` names a class of ours and its constructor arguments.

Unlike a bare `hydra.utils.instantiate`, a node can only build what this package defines, or modules that the user
names: a run directory from elsewhere runs no code. Keys and types are checked against the constructor's signature first,
so that a mistyped key fails at start with its name.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pydantic
from hydra.utils import get_object
from omegaconf import DictConfig, ListConfig, OmegaConf

PACKAGE = Path(__file__).resolve().parent
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"
"""Where the configuration lies: inside an installed package, or beside it in a checkout."""

CHECKED = (bool, int, float, str, type(None))


class ConfigError(ValueError):
    """A configuration that cannot be built; the message names the key, what was expected and what was got."""


def build(node: Any, key: str, trust: Sequence[str] = (), **extra: Any) -> Any:
    """Build the object that a node describes, nested nodes first; lists and plain mappings become Python's.

    Args:
        node: a resolved or unresolved OmegaConf node, or a plain value.
        key: the node's place in the configuration, for messages.
        trust: modules outside the package whose classes may be named.
        extra: constructor arguments that no configuration can hold.

    Raises:
        ConfigError: an unknown or forbidden target, an unknown key, a wrong type, or a constructor's refusal.
    """
    if isinstance(node, (ListConfig, list)):
        return [build(item, f"{key}[{index}]", trust) for index, item in enumerate(node)]
    if not isinstance(node, (DictConfig, dict)):
        return node
    items = dict(node.items()) if isinstance(node, DictConfig) else node
    target = items.get("_target_")
    values = {name: build(value, f"{key}.{name}", trust) for name, value in items.items() if name != "_target_"}
    if target is None:
        return {**values, **extra}
    constructor = resolve(str(target), f"{key}._target_", trust)
    values = _checked(constructor, values, key, extra)
    try:
        return constructor(**values, **extra)
    except (ValueError, TypeError, NotImplementedError) as error:
        raise ConfigError(f"{key}: {error}") from error


def resolve(target: str, key: str, trust: Sequence[str] = ()) -> Any:
    """The class or function a target names, if it is defined in this package or a trusted module."""
    allowed = ("pirl_rl", *trust)
    if not any(target.startswith(f"{module}.") for module in allowed):
        raise ConfigError(
            f"{key}: {target} is outside pirl_rl and may run any code; if you trust it, name its module: "
            f"trust=[{target.rpartition('.')[0]}]"
        )
    try:
        found = get_object(target)
    except Exception as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{key}: expected the dotted name of a class, got {target}: {reason}") from None
    # A dotted name also reaches what a module imports: pirl_rl.checkpoint.os.system is not ours.
    home = getattr(found, "__module__", None) or ""
    if not callable(found) or not any(home == module or home.startswith(f"{module}.") for module in allowed):
        raise ConfigError(f"{key}: {target} is not a class defined in {' or '.join(allowed)}")
    return found


def _checked(constructor: Any, values: dict[str, Any], key: str, extra: Mapping[str, Any]) -> dict[str, Any]:
    """The values with their types converted, or a ConfigError that names the key."""
    parameters = inspect.signature(constructor).parameters
    open_ended = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    hints = _hints(constructor)
    checked = {}
    for name, value in values.items():
        if name not in parameters and not open_ended:
            known = ", ".join(sorted(set(parameters) - set(extra)))
            raise ConfigError(f"{key}.{name}: {constructor.__qualname__} has no such argument; expected one of {known}")
        if value == "???":
            raise ConfigError(f"{key}.{name}: a value is missing")
        checked[name] = _convert(value, hints[name], f"{key}.{name}") if name in hints else value
    for name, parameter in parameters.items():
        required = parameter.default is parameter.empty and parameter.kind in (
            parameter.POSITIONAL_OR_KEYWORD,
            parameter.KEYWORD_ONLY,
        )
        if required and name not in values and name not in extra:
            raise ConfigError(f"{key}.{name}: a value is missing, {constructor.__qualname__} needs it")
    return checked


def _hints(constructor: Any) -> dict[str, Any]:
    function = constructor.__init__ if inspect.isclass(constructor) else constructor
    try:
        return typing.get_type_hints(function)
    except (NameError, TypeError):
        return {}


def _convert(value: Any, expected: Any, key: str) -> Any:
    plain = isinstance(value, CHECKED) or (isinstance(value, list) and all(isinstance(v, CHECKED) for v in value))
    if not plain:
        return value
    try:
        return pydantic.TypeAdapter(expected, config={"arbitrary_types_allowed": True}).validate_python(value)
    except pydantic.PydanticSchemaGenerationError:
        return value
    except pydantic.ValidationError as error:
        name = getattr(expected, "__name__", None) if inspect.isclass(expected) else str(expected)
        reason = error.errors()[0]["msg"]
        raise ConfigError(f"{key}: expected {name}, got {value!r} ({reason})") from None


def load_config(folder: Path) -> DictConfig:
    """The configuration of a run directory.

    Raises:
        ConfigError: the folder is not a run directory.
    """
    path = folder / ".hydra" / "config.yaml"
    if not path.is_file():
        raise ConfigError(f"{folder} is not a run directory: expected {path}")
    config = OmegaConf.load(path)
    if not isinstance(config, DictConfig):
        raise ConfigError(f"{path}: expected a mapping")
    OmegaConf.set_struct(config, True)
    return config
