"""Processes that run command lines in parallel and end with this process."""

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
"""Seconds between checks of the running processes."""

PR_SET_PDEATHSIG = 1
"""The option of prctl(2) by which a Linux process receives a signal when its parent ends."""

_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


@dataclass(frozen=True)
class Job:
    """A command line and the file to which its output is appended."""

    name: str
    command: tuple[str, ...]
    log: Path


class Launcher(Protocol):
    """Runs jobs."""

    def run(self, jobs: Sequence[Job], ended: Callable[[Job, int], None]) -> None:
        """Run all jobs, and call `ended` with a job and its exit code when it has ended."""
        ...


class Processes:
    """Runs each job in a process with the environment and the working directory of this one.

    The processes end with this one. On any exception here they get SIGINT, and this process waits for their end. If
    this process is killed, the Linux kernel kills them; on other systems they run to their end. Ctrl-C in a terminal
    reaches this process alone.

    Args:
        parallel: largest number of processes at a time.
        inherited: file descriptors that the processes keep open.
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
    """Collect SIGINT and SIGTERM in a list, because an exception in the middle of a fork would be lost."""
    noted: list[int] = []
    heard = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN]
    previous = {number: signal.signal(number, lambda number, frame: noted.append(number)) for number in heard}
    try:
        yield noted
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _stop(children: Sequence[subprocess.Popen], signals: Sequence[int]) -> None:
    """Ask all processes to stop, as Ctrl-C does, so that they save their state; another signal kills them."""
    if children:
        message = "\nstopping the candidates after their current update; Ctrl-C again kills them"
        print(message, file=sys.stderr, flush=True)
    for child in children:
        child.send_signal(signal.SIGINT)
    before = len(signals)
    while any(child.poll() is None for child in children):
        if len(signals) > before:
            for child in children:
                child.kill()
        time.sleep(POLL)


def _attach(parent: int) -> None:
    """Run in a new process: make it end with its parent and receive SIGINT even if the parent ignores that signal, as
    processes in the background of a shell do."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if _libc is not None:
        _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
