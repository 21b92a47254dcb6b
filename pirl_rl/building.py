"""Objects from configuration nodes: a node with a `_target_` names a class and its constructor arguments.

Unlike `hydra.utils.instantiate`, a node can only build classes of this package or objects of modules that the user
trusts, so that a foreign run directory runs no code. Keys and types are checked against the signature of the
constructor first, so that a mistyped key is refused by its name.
"""

from __future__ import annotations

import importlib
import inspect
import re
import typing
from collections.abc import Mapping, Sequence
from typing import Any

import pydantic
import pydantic_core
from omegaconf import DictConfig, ListConfig, OmegaConf

from pirl_rl.errors import ConfigError, PirlError

CHECKED = (bool, int, float, str, type(None))
"""Types of values that are checked against the constructor's annotation."""


def build(node: Any, key: str, trust: Sequence[str] = (), parts: Mapping[str, Any] | None = None, **extra: Any) -> Any:
    """Build the object that a node describes, after the objects of nested nodes.

    Args:
        node: an OmegaConf mapping with a `_target_`.
        key: key of the node in the configuration, for messages.
        trust: modules outside the package that the node may name.
        parts: objects by the names of the arguments for which this and all nested constructors get them, if required.
        extra: constructor arguments of this object that no configuration can hold.

    Raises:
        ConfigError: for an unknown or forbidden target, an unknown key, a wrong type, or a `PirlError` of the
            constructor, which refuses an argument. Any other error of a constructor is a bug and is left unchanged.
    """
    if isinstance(node, DictConfig) and OmegaConf.is_missing(node, "_target_"):
        raise ConfigError(f"{key}._target_: a value is missing, expected {key}._target_=my_module.MyClass")
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise ConfigError(f"{key}: expected settings with a _target_, got {node!r}")
    parts = parts or {}
    values = {str(name): _value(node, name, f"{key}.{name}", trust, parts) for name in node}
    constructor = resolve(str(values.pop("_target_")), f"{key}._target_", trust)
    values = _checked(constructor, values, key, extra, parts)
    if missing := ", ".join(sorted(getattr(constructor, "__abstractmethods__", ()))):
        raise ConfigError(f"{key}: {constructor.__qualname__} lacks {missing}")
    try:
        return constructor(**values, **extra)
    except PirlError as error:
        message = str(error)
        argument = message.partition(":")[0].partition(".")[0]
        if message.startswith((f"{key}.", f"{key}:")):
            raise ConfigError(message) from error
        raise ConfigError(f"{key}{'.' if argument in parameters_of(constructor) else ': '}{message}") from error


def _value(node: DictConfig | ListConfig, name: Any, key: str, trust: Sequence[str], parts: Mapping[str, Any]) -> Any:
    """An entry of a node: nodes with a `_target_` are built, lists and other mappings become Python objects."""
    if OmegaConf.is_missing(node, name):
        raise ConfigError(f"{key}: a value is missing, expected {key}=...")
    value = node[name]
    if isinstance(value, ListConfig):
        return [_value(value, index, f"{key}[{index}]", trust, parts) for index in range(len(value))]
    if isinstance(value, DictConfig):
        if "_target_" in value:
            return build(value, key, trust, parts)
        return {inner: _value(value, inner, f"{key}.{inner}", trust, parts) for inner in value}
    return value


def resolve(target: str, key: str, trust: Sequence[str] = ()) -> Any:
    """The class of this package, or the callable of a trusted module, that a target names.

    Functions of this package are refused: unlike its constructors, they may read and write files.

    Args:
        target: name of the object, such as "pirl_rl.sets.Box".
        key: key of the target in the configuration, for messages.
        trust: modules outside the package whose objects are allowed.

    Raises:
        ConfigError: if the target does not exist or is not allowed.
    """
    if not _within(target, ("pirl_rl", *trust)):
        raise ConfigError(
            f"{key}: {target} is outside pirl_rl and may run any code; if you trust it, name its module: "
            f"trust=[{target.rpartition('.')[0] or target}]"
        )
    module, _, name = target.rpartition(".")
    if not module:
        raise ConfigError(f"{key}: expected a class as module.Name, got {target}")
    try:
        # Another error during the import is a bug of the module and is left unchanged.
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{key}: cannot load {target}: {type(error).__name__}: {error}") from error
    # A module also has the names that it imports, such as pirl_rl.checkpoint.Path.
    defined_in = getattr(found, "__module__", None) or ""
    own = inspect.isclass(found) and _within(defined_in, ("pirl_rl",))
    if not (own or (callable(found) and _within(defined_in, trust))):
        raise ConfigError(f"{key}: {target} is not a class defined in {' or '.join(('pirl_rl', *trust))}")
    return found


def trusted_modules(trust: str | Sequence[str] | None) -> list[str]:
    """The names of the modules in a setting `trust`.

    Args:
        trust: a list of names, or text such as "my_module", "[my_module,other]" or "['my_module']".
    """
    return re.findall(r"[\w.]+", trust) if isinstance(trust, str) else [*(trust or ())]


def _within(name: str, modules: Sequence[str]) -> bool:
    return any(name == module or name.startswith(f"{module}.") for module in modules)


def _checked(
    constructor: Any, values: dict[str, Any], key: str, extra: Mapping[str, Any], parts: Mapping[str, Any]
) -> dict[str, Any]:
    """The values with converted types and with the parts that the constructor requires.

    Raises:
        ConfigError: for an unknown key, a missing value or a wrong type.
    """
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
            raise ConfigError(f"{key}.{name}: a value is missing, {constructor.__qualname__} requires it")
        checked[name] = parts[name]
    return checked


def parameters_of(constructor: Any) -> Mapping[str, inspect.Parameter]:
    """The parameters of a function or of the `__init__` of a class, which a metaclass like TorchRL's may hide."""
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
    """Convert a plain value, or a list of them, to the expected type; other values are returned unchanged.

    Raises:
        ConfigError: if the value cannot be converted.
    """
    plain = isinstance(value, CHECKED) or (isinstance(value, list) and all(isinstance(v, CHECKED) for v in value))
    if not plain:
        return value
    try:
        return pydantic.TypeAdapter(expected, config={"arbitrary_types_allowed": True}).validate_python(value)
    except (pydantic.PydanticSchemaGenerationError, pydantic_core.SchemaError):
        return value  # pydantic cannot check this type, for example a protocol
    except pydantic.ValidationError as error:
        name = getattr(expected, "__name__", None) if inspect.isclass(expected) else str(expected)
        name = str(name).replace("collections.abc.Sequence", "list").replace("collections.abc.Mapping", "dict")
        reason = error.errors()[0]["msg"]
        raise ConfigError(f"{key}: expected {name}, got {value!r} ({reason})") from None
