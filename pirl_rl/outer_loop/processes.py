"""Runs command lines side by side, none of which outlives this process."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

POLL = 0.05
"""Seconds between looks at the running ones."""

PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


@dataclass(frozen=True)
class Job:
    """A command line and the file that its output goes to."""

    name: str
    command: tuple[str, ...]
    log: Path


class Launcher(Protocol):
    """Runs jobs and calls `ended` with each and its exit code as it ends."""

    def run(self, jobs: Sequence[Job], ended: Callable[[Job, int], None]) -> None: ...


class Processes:
    """Each job a process of its own, with this one's environment and working directory.

    They end with this process: on any exception here they get SIGINT and are waited for, and if this one is killed the
    kernel kills them (on Linux; elsewhere they end by themselves). Ctrl-C in a terminal reaches this process alone.

    Args:
        parallel: most at a time.
        inherited: file descriptors that they keep open.
    """

    def __init__(self, parallel: int = 1, inherited: Sequence[int] = ()):
        self.parallel, self.inherited = parallel, tuple(inherited)

    def run(self, jobs: Sequence[Job], ended: Callable[[Job, int], None]) -> None:
        waiting, running = deque(jobs), dict[Job, subprocess.Popen]()
        with _noted() as signals:
            try:
                while waiting or running:
                    while waiting and len(running) < self.parallel and not signals:
                        job = waiting.popleft()
                        running[job] = self._start(job)
                    done = [job for job, child in running.items() if child.poll() is not None]
                    for job in done:
                        ended(job, running.pop(job).returncode)
                    if signals:
                        raise KeyboardInterrupt
                    if not done:
                        time.sleep(POLL)
            finally:
                _stop(list(running.values()), signals)

    def _start(self, job: Job) -> subprocess.Popen:
        job.log.parent.mkdir(parents=True, exist_ok=True)
        with job.log.open("ab") as log:
            return subprocess.Popen(
                job.command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                pass_fds=self.inherited,
                start_new_session=True,
                preexec_fn=partial(_attach, os.getpid()),
            )


@contextmanager
def _noted() -> Iterator[list[int]]:
    """SIGINT and SIGTERM are put on a list: an exception would be lost if it came in the middle of a fork."""
    noted: list[int] = []
    heard = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN]
    previous = {number: signal.signal(number, lambda number, frame: noted.append(number)) for number in heard}
    try:
        yield noted
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _stop(children: Sequence[subprocess.Popen], signals: Sequence[int]) -> None:
    """Ask all to end, as Ctrl-C does, so that they keep what they have; another signal here kills them."""
    if children:
        print("\nstopping the candidates after their update; Ctrl-C again kills them", file=sys.stderr, flush=True)
    for child in children:
        child.send_signal(signal.SIGINT)
    before = len(signals)
    while any(child.poll() is None for child in children):
        if len(signals) > before:
            for child in children:
                child.kill()
        time.sleep(POLL)


def _attach(parent: int) -> None:
    """In a new process: die with the parent, and hear SIGINT even where that ignores it, as in the background."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if _libc is not None:
        _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
