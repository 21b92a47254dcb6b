"""From configuration nodes to objects: a node with `_target_` names a class of ours and its constructor arguments.

Unlike a bare `hydra.utils.instantiate`, a node can only build the classes of this package, or what modules that the
user names define: a run directory from elsewhere runs no code. Keys and types are checked against the constructor's
signature first, so that a mistyped key fails at start with its name.
"""

from __future__ import annotations

import importlib
import inspect
import re
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pydantic
import pydantic_core
import yaml
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.errors import ConfigError
from pirl_rl.files import replacing

PACKAGE = Path(__file__).resolve().parent
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"
"""Where the configuration lies: inside an installed package, or beside it in a checkout."""

CONFIG = Path(".hydra") / "config.yaml"
"""Where a run directory keeps its own."""

REFERENCE = re.compile(r"\$\{[\w.]+\}")
CHECKED = (bool, int, float, str, type(None))


def build(node: Any, key: str, trust: Sequence[str] = (), parts: Mapping[str, Any] | None = None, **extra: Any) -> Any:
    """Build the object that a node describes, nested nodes first.

    Args:
        node: an OmegaConf mapping with `_target_`.
        key: the node's place in the configuration, for messages.
        trust: modules outside the package that may be named.
        parts: objects that this and all nested constructors get where they require an argument of that name.
        extra: constructor arguments of this object that no configuration can hold.

    Raises:
        ConfigError: an unknown or forbidden target, an unknown key, a wrong type, or a constructor's refusal.
    """
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise ConfigError(f"{key}: expected settings with a _target_, got {node!r}")
    parts = parts or {}
    values = {str(name): _value(node, name, f"{key}.{name}", trust, parts) for name in node}
    constructor = resolve(str(values.pop("_target_")), f"{key}._target_", trust)
    values = _checked(constructor, values, key, extra, parts)
    try:
        return constructor(**values, **extra)
    except (ValueError, TypeError, AttributeError, NotImplementedError) as error:
        message = str(error)
        raise ConfigError(message if message.startswith(f"{key}.") else f"{key}: {message}") from error


def _value(node: DictConfig | ListConfig, name: Any, key: str, trust: Sequence[str], parts: Mapping[str, Any]) -> Any:
    """An entry of a node: nodes with `_target_` built, lists and plain mappings as Python's."""
    if OmegaConf.is_missing(node, name):
        raise ConfigError(f"{key}: a value is missing, give {key}=...")
    value = node[name]
    if isinstance(value, ListConfig):
        return [_value(value, index, f"{key}[{index}]", trust, parts) for index in range(len(value))]
    if isinstance(value, DictConfig):
        if "_target_" in value:
            return build(value, key, trust, parts)
        return {inner: _value(value, inner, f"{key}.{inner}", trust, parts) for inner in value}
    return value


def resolve(target: str, key: str, trust: Sequence[str] = ()) -> Any:
    """What a target names: a class defined in this package, or anything callable defined in a trusted module.

    Constructors here only keep their arguments, functions may act: a configuration never calls those.
    """
    if not _within(target, ("pirl_rl", *trust)):
        raise ConfigError(
            f"{key}: {target} is outside pirl_rl and may run any code; if you trust it, name its module: "
            f"trust=[{target.rpartition('.')[0] or target}]"
        )
    try:
        module, _, name = target.rpartition(".")
        found = getattr(importlib.import_module(module), name)
    except Exception as error:
        raise ConfigError(f"{key}: cannot load {target}: {type(error).__name__}: {error}") from None
    # A module also holds what it imports: pirl_rl.checkpoint.Path is not ours.
    home = getattr(found, "__module__", None) or ""
    if not ((inspect.isclass(found) and _within(home, ("pirl_rl",))) or (callable(found) and _within(home, trust))):
        raise ConfigError(f"{key}: {target} is not a class defined in {' or '.join(('pirl_rl', *trust))}")
    return found


def _within(name: str, modules: Sequence[str]) -> bool:
    return any(name == module or name.startswith(f"{module}.") for module in modules)


def _checked(
    constructor: Any, values: dict[str, Any], key: str, extra: Mapping[str, Any], parts: Mapping[str, Any]
) -> dict[str, Any]:
    """The values with their types converted and with the parts they lack, or a ConfigError that names the key."""
    parameters = parameters_of(constructor)
    open_ended = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    hints = _hints(constructor)
    checked = {}
    for name, value in values.items():
        if name in extra or (name not in parameters and not open_ended):
            known = ", ".join(sorted(set(parameters) - set(extra)))
            raise ConfigError(f"{key}.{name}: {constructor.__qualname__} has no such argument; expected one of {known}")
        checked[name] = convert(value, hints[name], f"{key}.{name}") if name in hints else value
    for name, parameter in parameters.items():
        required = parameter.default is parameter.empty and parameter.kind in (
            parameter.POSITIONAL_OR_KEYWORD,
            parameter.KEYWORD_ONLY,
        )
        if not required or name in values or name in extra:
            continue
        if name not in parts:
            raise ConfigError(f"{key}.{name}: a value is missing, {constructor.__qualname__} needs it")
        checked[name] = parts[name]
    return checked


def parameters_of(constructor: Any) -> Mapping[str, inspect.Parameter]:
    """The parameters of a class's own constructor, which a metaclass as TorchRL's may hide, or of a function."""
    if not inspect.isclass(constructor) or constructor.__init__ is object.__init__:
        return inspect.signature(constructor).parameters
    _, *parameters = inspect.signature(constructor.__init__).parameters.items()
    return dict(parameters)


def _hints(constructor: Any) -> dict[str, Any]:
    function = constructor.__init__ if inspect.isclass(constructor) else constructor
    try:
        return typing.get_type_hints(function)
    except (NameError, TypeError):
        return {}


def convert(value: Any, expected: Any, key: str) -> Any:
    """A plain value as the type it should have; ConfigError where it is none."""
    plain = isinstance(value, CHECKED) or (isinstance(value, list) and all(isinstance(v, CHECKED) for v in value))
    if not plain:
        return value
    try:
        return pydantic.TypeAdapter(expected, config={"arbitrary_types_allowed": True}).validate_python(value)
    except (pydantic.PydanticSchemaGenerationError, pydantic_core.SchemaError):
        return value  # a type that pydantic knows no check for, as a protocol
    except pydantic.ValidationError as error:
        name = getattr(expected, "__name__", None) if inspect.isclass(expected) else str(expected)
        reason = error.errors()[0]["msg"]
        raise ConfigError(f"{key}: expected {name}, got {value!r} ({reason})") from None


def load_config(folder: Path) -> DictConfig:
    """The configuration of a run directory.

    It may refer to its own keys, `${env.dt}`, but call no resolver: `${oc.env:TOKEN}` would read what is not its own.

    Raises:
        ConfigError: the folder is not a run directory, or its configuration calls resolvers.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ConfigError(f"{folder} is not a run directory: expected {path}")
    try:
        config = OmegaConf.load(path)
    except (yaml.YAMLError, UnicodeDecodeError, OmegaConfBaseException, OSError) as error:
        raise ConfigError(f"{path} is not readable: {str(error).partition(chr(10))[0]}") from None
    if not isinstance(config, DictConfig):
        raise ConfigError(f"{path}: expected a mapping")
    _refuse_resolvers(OmegaConf.to_container(config, resolve=False), str(path))
    OmegaConf.set_struct(config, True)
    return config


def _refuse_resolvers(value: Any, key: str) -> None:
    if isinstance(value, (dict, list)):
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            _refuse_resolvers(inner, f"{key}: {name}")
    elif isinstance(value, str) and "${" in REFERENCE.sub("", value):
        raise ConfigError(f"{key}: a run directory may refer to its own keys only, got {value}; write the value itself")


def save_config(config: DictConfig, folder: Path) -> None:
    """Write what `load_config` reads."""
    with replacing(folder / CONFIG) as file:
        file.write(OmegaConf.to_yaml(config))
