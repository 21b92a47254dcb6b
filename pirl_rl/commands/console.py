"""Parts that the commands share: overrides of a run's settings, the table of metrics, and the report of errors."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import shlex
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException, HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.building import convert, trusted_modules
from pirl_rl.errors import INTERRUPTED, ConfigError, Interrupted, PirlError
from pirl_rl.places import is_users, users_frames
from pirl_rl.progress import helped

EXPECTED = (PirlError, HydraException, OmegaConfBaseException, yaml.YAMLError)
"""Errors whose message alone tells the user what to correct."""

UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)
"""Reasons of the operating system not to write a file, which are no mistakes of a program."""


def quiet_libraries() -> None:
    """Silence the warnings of torch and TorchRL about each other, about which a user can do nothing."""
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"(torch|tensordict|torchrl)\b")


def program(function: Callable[[Sequence[str]], None]) -> Callable[..., None]:
    """Make a command of a function of its arguments, with the help that the docstring of its module is.

    Without arguments the command takes those of the command line. Ctrl-C ends it with the exit code `INTERRUPTED`.
    """

    @functools.wraps(function)
    def main(arguments: Sequence[str] | None = None) -> None:
        given = sys.argv[1:] if arguments is None else arguments
        if helped(given, sys.modules[function.__module__].__doc__):
            return
        quiet_libraries()
        try:
            function(given)
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
            raise SystemExit(INTERRUPTED) from None

    return main


TRAINED = ("actor", "critic", "critics")
"""Groups of settings that cannot change in a run that is trained, since they are those of its networks."""

SWITCHES = ("check", "compile", "verbose", "figures", "report")
"""Settings of the commands that are true or false."""

Meanings = Mapping[str, Mapping[str, str]]
"""What metrics mean, by the group of the table to which they belong and by metric."""


def outcome(lines: Sequence[str], summary: Mapping[str, float], meanings: Meanings, verbose: bool) -> str:
    """What a command prints at its end: the verdict, and the table of all metrics if it is asked for.

    Without a verdict the table is printed in any case.
    """
    if not lines:
        return metrics_table(summary, meanings)
    if verbose:
        return "\n".join([metrics_table(summary, meanings), *lines, ""])
    return "\n".join(["", *lines, "metrics   verbose=true prints all of them with their meaning", ""])


def metrics_table(summary: Mapping[str, float], meanings: Meanings) -> str:
    """A table of the entries of a summary: those without a meaning, and then a group for each evaluator."""
    known = {name for group in meanings.values() for name in group}
    groups = {"run": dict.fromkeys(name for name in summary if name not in known), **meanings}
    rows = []
    for group, texts in groups.items():
        if any(name in summary for name in texts):
            rows += ["", group]
        for name in (name for name in texts if name in summary):
            first, *others = textwrap.wrap(texts[name] or "", 82) or [""]
            rows += [f"  {name:<20} {summary[name]:>12.5g}   {first}".rstrip(), *(f"{'':<38}{line}" for line in others)]
    return "\n".join([*rows, ""])


def named_modules(overrides: Sequence[str], trust: str | Sequence[str] | None = ()) -> list[str]:
    """The modules that a setting `trust` lists, and those that the overrides name by a `_target_`."""
    targets = [value for key, _, value in (item.partition("=") for item in overrides) if key.endswith("_target_")]
    return [*trusted_modules(trust), *(target.strip("'\"").partition(".")[0] for target in targets)]


def one_folder(arguments: Sequence[str], key: str, meaning: str) -> Path:
    """The folder that the only argument with a key names.

    Raises:
        ConfigError: if there is no such argument, or more than one, of which all others would be ignored.
    """
    named = [text.partition("=")[2] for text in arguments if text.startswith(f"{key}=")]
    if len(named) != 1:
        raise ConfigError(f"{key}: expected {key}=RUN_DIR once, {meaning}, got {' and '.join(named) or 'none'}")
    return Path(named[0])


def read_settings(arguments: Sequence[str]) -> dict[str, Any]:
    """The settings of a command without a configuration, by their keys.

    Args:
        arguments: settings `key=value`, with values in YAML.

    Raises:
        ConfigError: with the argument that cannot be read.
    """
    settings = OmegaConf.create()
    for text in arguments:
        try:
            settings.merge_with_dotlist([text])
        except (OmegaConfBaseException, ValueError, yaml.YAMLError) as error:
            raise ConfigError(f"{text}: expected key=value ({_first_line(str(error))})") from None
    return OmegaConf.to_container(settings)  # type: ignore[return-value]


def override(config: DictConfig, text: str) -> tuple[Any, Any]:
    """Apply an override `key=value` to the configuration of a run; returns the value before and the new one.

    Raises:
        ConfigError: if the text is no such override, or sets more than a single setting.
    """
    try:
        parsed = OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise ConfigError(f"{text}: {error}") from None
    plain = "=" in text and not text.startswith(("+", "~")) and not parsed.is_sweep_override()
    if not plain or isinstance(OmegaConf.select(config, parsed.key_or_group), DictConfig):
        raise ConfigError(f"{text}: expected key=value of an existing run's single settings only")
    before = OmegaConf.select(config, parsed.key_or_group)
    OmegaConf.update(config, parsed.key_or_group, parsed.value())
    return before, parsed.value()


def read_switches(config: DictConfig) -> None:
    """Replace words for true and false, such as `off`, which Hydra reads as text.

    Args:
        config: the configuration of a run; changed in place.

    Raises:
        ConfigError: if one of `SWITCHES` is no such word.
    """
    for name in (name for name in SWITCHES if name in config):
        config[name] = convert(config[name], bool, name)


@contextlib.contextmanager
def reported(folder: Path, one_of_many: bool = False, again: Sequence[str] = ()) -> Iterator[None]:
    """Turn errors into messages and an exit code.

    An expected error, such as a refused setting, becomes one line. So does an error in the user's code, with the place
    there; HYDRA_FULL_ERROR=1 in the environment prints its traceback too. Any other error is a bug in this package, and
    its traceback is printed.

    Args:
        folder: the run directory, for the hint on how to resume.
        one_of_many: whether this is a job of a sweep, whose other jobs still run.
        again: further arguments that a resumed run needs, for the hint.
    """
    try:
        yield
    except Interrupted as stop:
        line = shlex.join([f"resume={folder}", *again])
        print(f"{stop}; resume with: python -m pirl_rl.train {line}", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except EXPECTED as error:
        _end(f"error: {_one_line(error)}", one_of_many)
    except Exception as error:
        place = _users_place(error)
        known = place or (isinstance(error, OSError) and error.errno in UNWRITABLE)
        if not known or (place and os.environ.get("HYDRA_FULL_ERROR") == "1"):
            traceback.print_exc()
        if isinstance(error, OSError) and not place:
            _end(f"error: {error.strerror or error}: {error.filename or folder}", one_of_many)
        reason = error.msg if isinstance(error, SyntaxError) else str(error)  # whose text repeats the place
        _end(f"error: {type(error).__name__}: {_first_line(reason)}{place}", one_of_many)


def _end(message: str, one_of_many: bool) -> None:
    print(message, file=sys.stderr, flush=True)
    if one_of_many:
        raise CompactHydraException(message) from None
    raise SystemExit(1) from None


def _one_line(error: Exception) -> str:
    if isinstance(error, OmegaConfBaseException):
        return f"{error.full_key}: {_first_line(str(error.msg))}"
    if isinstance(error, yaml.YAMLError):
        return " ".join(str(error).split())  # the file and the line stand at its end
    return str(error)


def _first_line(text: str) -> str:
    return text.partition("\n")[0]


def _users_place(error: Exception) -> str:
    """ " (file, line)" of the innermost frame outside this package and the libraries; empty without one."""
    if isinstance(error, SyntaxError) and error.filename and is_users(error.filename):
        return f" ({error.filename}, line {error.lineno})"
    frames = users_frames(error)
    return f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
