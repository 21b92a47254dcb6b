"""A lock on a run directory, so that no two processes write into it at once."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from filelock import FileLock, Timeout

from pirl_rl.errors import RunError
from pirl_rl.files import replacing
from pirl_rl.run_directory import RunDirectory


@contextmanager
def locked(run: RunDirectory) -> Iterator[None]:
    """Hold the lock of a run directory during the block.

    The operating system frees the lock of a process that dies, so that a killed run can be resumed at once.

    Raises:
        RunError: if another process holds the lock; the message says which.
        OSError: if the directory cannot be written.
    """
    run.lock.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(run.lock)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise RunError(
            f"{run}: another process writes into this run directory, {_holder(run)}; wait or stop it"
        ) from None
    try:
        with replacing(run.holder) as file:
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
        yield
    finally:
        run.holder.unlink(missing_ok=True)
        lock.release()


def _holder(run: RunDirectory) -> str:
    try:
        return run.holder.read_text(encoding="utf-8")
    except OSError:  # between taking the lock and noting its holder
        return "which has just started"
