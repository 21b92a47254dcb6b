"""The directory of an outer loop, in which one loop at a time works with the settings of its first start."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from omegaconf import OmegaConf

from pirl_rl.errors import ConfigError
from pirl_rl.run_directory import RunDirectory

SETTINGS_FILE = "tune.yaml"
"""The file with the settings of the loop's first start."""

CHANGEABLE = ("rounds", "extra_rounds", "parallel", "population", "out")
"""Settings that may differ when the loop is started again."""

LOCK = ".lock"
"""The file that a working loop and its candidates keep locked; it holds the id of the loop's process."""

PATIENCE = 30.0
"""Seconds to wait for the candidates of a killed loop to end."""


def check_directory(out: Path, settings: dict) -> None:
    """Refuse a directory that holds anything but a loop with these settings.

    Args:
        out: the directory.
        settings: the settings of the loop.

    Raises:
        ConfigError: if it holds other files, or a loop with other settings; the message names the settings that differ.
    """
    if not (out / SETTINGS_FILE).exists():
        if any(not path.name.startswith(".") for path in out.iterdir()):
            raise ConfigError(f"out: expected an empty directory or one with {SETTINGS_FILE}, got {out}")
        return
    RunDirectory(out).refuse_links()
    before = OmegaConf.to_container(OmegaConf.load(out / SETTINGS_FILE))
    differing = [key for key in _differing(before, settings) if key not in CHANGEABLE]
    if differing:
        raise ConfigError(
            f"{', '.join(differing)}: expected the settings of {out / SETTINGS_FILE}, got others; only "
            f"{', '.join(CHANGEABLE[:-1])} may change, choose another out=... to change others"
        )


def _differing(before: object, after: object, key: str = "") -> list[str]:
    if isinstance(before, dict) and isinstance(after, dict):
        names = {**before, **after}
        pairs = ((f"{key}.{name}".lstrip("."), before.get(name), after.get(name)) for name in names)
        return [key for name, a, b in pairs for key in _differing(a, b, name)]
    return [] if before == after else [key]


@contextmanager
def locked(out: Path) -> Iterator[int]:
    """Lock a loop's directory.

    Yields:
        The descriptor of the lock file. Candidates inherit it, so that the directory stays locked until they end too.

    Raises:
        ConfigError: if another loop works in the directory.
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
    try:
        import fcntl
    except ModuleNotFoundError:
        raise ConfigError("tune: it locks its folder with fcntl, which Linux and macOS have") from None
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 20, 0).decode() or "?"
            if _lives(holder) or time.monotonic() > deadline:
                raise ConfigError(f"out: another loop works in {out}, process {holder}") from None
            time.sleep(0.1)


def _lives(process: str) -> bool:
    """Whether a process exists."""
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, ValueError):
        return False
    except PermissionError:
        pass
    return True
