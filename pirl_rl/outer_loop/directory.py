"""The directory of an outer loop: one loop works in it at a time, always with the settings of its first start."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from omegaconf import OmegaConf

from pirl_rl.errors import ConfigError
from pirl_rl.run_directory import RunDirectory

KEPT = "tune.yaml"
"""The file with the settings of the loop's first start."""

CHANGEABLE = ("rounds", "extra_rounds", "parallel", "out")
"""Settings that may differ when the loop is started again."""

LOCK = ".lock"
PATIENCE = 30.0
"""Seconds until the candidates of a loop that was killed have ended."""


def check(out: Path, settings: dict) -> None:
    """Refuse a directory that is no loop's, or one of another.

    Raises:
        ConfigError: naming the settings that differ.
    """
    if not (out / KEPT).exists():
        if any(not path.name.startswith(".") for path in out.iterdir()):
            raise ConfigError(f"out: {out} is not empty and no loop's directory, expected {KEPT} in it")
        return
    RunDirectory(out).refuse_links()
    before = OmegaConf.to_container(OmegaConf.load(out / KEPT))
    differing = [key for key in _differing(before, settings) if key not in CHANGEABLE]
    if differing:
        raise ConfigError(
            f"{', '.join(differing)}: expected the settings of {out / KEPT}, got others; only "
            f"{', '.join(CHANGEABLE[:-1])} may change, take another out=... for the rest"
        )


def _differing(before: object, after: object, key: str = "") -> list[str]:
    if isinstance(before, dict) and isinstance(after, dict):
        names = {**before, **after}
        pairs = ((f"{key}.{name}".lstrip("."), before.get(name), after.get(name)) for name in names)
        return [found for name, a, b in pairs for found in _differing(a, b, name)]
    return [] if before == after else [key]


@contextmanager
def locked(out: Path) -> Iterator[int]:
    """Hold a loop's directory; yields the descriptor, which candidates inherit so that they hold it too.

    Raises:
        ConfigError: another loop holds it.
    """
    descriptor = os.open(out / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    try:
        _lock(descriptor, out)
        os.truncate(descriptor, 0)
        os.pwrite(descriptor, str(os.getpid()).encode(), 0)
        yield descriptor
    finally:
        os.close(descriptor)


def _lock(descriptor: int, out: Path) -> None:
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 20, 0).decode() or "?"
            if _lives(holder) or time.monotonic() > deadline:
                raise ConfigError(f"out: another loop, process {holder}, works in {out}; one at a time") from None
            time.sleep(0.1)


def _lives(process: str) -> bool:
    """Whether a process is there; the candidates of one that was killed end by themselves."""
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, ValueError):
        return False
    except PermissionError:
        pass
    return True
