"""What the commands share: overrides of a run's settings, the table of metrics, errors told in one line, warnings."""

from __future__ import annotations

import contextlib
import sys
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException, HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.errors import CheckpointError, CollectorError, ConfigError, DivergenceError, Interrupted, ProblemError

EXPECTED = (
    ConfigError,
    CheckpointError,
    CollectorError,
    DivergenceError,
    ProblemError,
    HydraException,
    OmegaConfBaseException,
)
"""Errors that are the user's to mend: their message is enough."""

INTERRUPTED = 130


def quiet_libraries() -> None:
    """What libraries warn of about each other, while they compile, no user can mend."""
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"(torch|tensordict|torchrl)\b")


def table(summary: Mapping[str, float], meanings: Mapping[str, str]) -> str:
    """The numbers of a summary with the meanings of those that are metrics."""
    rows = []
    for name, value in summary.items():
        first, *others = textwrap.wrap(meanings.get(name, ""), 84) or [""]
        rows += [f"{name:<20} {value:>12.5g}   {first}".rstrip(), *(f"{'':<36}{line}" for line in others)]
    return "\n".join(["", f"{'metric':<20} {'value':>12}   meaning", "-" * 120, *rows, ""])


def named_modules(overrides: Sequence[str]) -> list[str]:
    """The modules of the `_target_`s that were typed."""
    targets = [value for key, _, value in (item.partition("=") for item in overrides) if key.endswith("_target_")]
    return [target.partition(".")[0] for target in targets]


def override(config: DictConfig, text: str) -> None:
    """Apply a typed `key=value` to a run's configuration."""
    try:
        parsed = OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise ConfigError(f"{text}: {error}") from None
    plain = "=" in text and not text.startswith(("+", "~")) and not parsed.is_sweep_override()
    if not plain or isinstance(OmegaConf.select(config, parsed.key_or_group), DictConfig):
        raise ConfigError(f"{text}: a finished run takes key=value of single settings only")
    OmegaConf.update(config, parsed.key_or_group, parsed.value())


@contextlib.contextmanager
def told(folder: Path, one_of_many: bool = False) -> Iterator[None]:
    """Expected errors end as one message and an exit code; in a sweep the other jobs still run."""
    try:
        yield
    except Interrupted as stop:
        print(f"{stop}; go on with: python -m pirl_rl.train resume={folder}", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    except EXPECTED as error:
        message = f"error: {_one_line(error)}"
        print(message, file=sys.stderr, flush=True)
        if one_of_many:
            raise CompactHydraException(message) from None
        raise SystemExit(1) from None


def _one_line(error: Exception) -> str:
    if isinstance(error, OmegaConfBaseException):
        return f"{error.full_key}: {str(error.msg).partition(chr(10))[0]}"
    return str(error)
