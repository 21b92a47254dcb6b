"""An advisor that runs any program, such as a coding agent, which reads a prompt file and writes a plan file."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from pirl_rl.errors import AdvisorError, ArgumentError
from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.advisors.answer import one_line, read_answer
from pirl_rl.outer_loop.prompt import request_text
from pirl_rl.outer_loop.redaction import redact

TAIL = 2_000
"""Number of characters at the end of a failed program's output that the error quotes."""

BUFFERED = 16 * TAIL
"""Number of bytes of that output in memory. It is larger than `TAIL`, so that a secret that is cut at the start of the
buffer, where it cannot be recognised, is not quoted."""


class Command:
    """Runs a program without a shell in a temporary folder, so that scripts among its arguments need absolute paths.

    Args:
        command: the command line, such as "my_agent --quiet {prompt} {plan}"; {prompt} and {plan} are replaced by the
            paths of the two files, also inside an argument. If the program fails, the error quotes the end of its
            output.
        timeout: time in s after which the program and its child processes are killed.

    Raises:
        ArgumentError: if the command is no command line, has no {plan} or names no program, or the timeout is not
            positive.
    """

    def __init__(self, command: str, timeout: float = 600.0):
        try:
            self.arguments = shlex.split(command)
        except ValueError as error:
            raise ArgumentError(f"command: expected a program and its arguments, got {command!r} ({error})") from None
        if not any("{plan}" in argument for argument in self.arguments):
            raise ArgumentError(f"command: expected {{plan}}, the file that the program writes, in {command!r}")
        program = shutil.which(self.arguments[0])
        if program is None:
            raise ArgumentError(f"command: expected an executable program, got {self.arguments[0]}")
        if not timeout > 0:
            raise ArgumentError(f"timeout: expected seconds > 0, got {timeout}")
        self.arguments[0], self.timeout = str(Path(program).absolute()), timeout

    def propose(self, request: Request) -> str:
        attempt = 2 if request.errors else 1
        prompt, plan = (request.folder / f"advisor-{attempt}-{name}" for name in ("prompt.md", "plan.json"))
        try:
            plan.unlink(missing_ok=True)  # an earlier attempt may have been killed
            prompt.unlink(missing_ok=True)
            prompt.write_text(redact(request_text(request)), encoding="utf-8")
        except OSError as error:
            raise AdvisorError(f"command: {error.filename}: {error.strerror}") from None
        files = {"{prompt}": str(prompt.absolute()), "{plan}": str(plan.absolute())}
        command = [re.sub(r"\{prompt\}|\{plan\}", lambda found: files[found[0]], text) for text in self.arguments]
        try:
            _run(command, request.folder, self.timeout)
            return read_answer(plan)
        finally:
            for path in (prompt, plan):  # the record of the loop keeps both, without secrets
                with contextlib.suppress(OSError):
                    path.unlink()


def _run(command: Sequence[str], folder: Path, timeout: float) -> None:
    """Run a program to its end, and kill the processes that remain in its group.

    Raises:
        AdvisorError: if the program cannot be started, takes too long or fails.
    """
    try:
        process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        raise AdvisorError(f"command: {command[0]} cannot be started: {error}") from None
    assert process.stdout is not None
    tail = _Tail(process.stdout)
    reason = ""
    try:
        if process.wait(timeout):
            reason = f"{command[0]} ended with exit code {process.returncode}"
    except subprocess.TimeoutExpired:
        reason = f"{command[0]} took longer than {timeout:g} s"
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if reason:
        raise AdvisorError(f"command: {reason}{tail.text()}")


class _Tail(threading.Thread):
    """Reads a stream until all its writers have closed it, and keeps its last bytes."""

    def __init__(self, stream: IO[bytes]):
        super().__init__(daemon=True)
        self.stream, self.content = stream, b""
        self.start()

    def run(self) -> None:
        with self.stream:
            while chunk := os.read(self.stream.fileno(), 65_536):
                self.content = (self.content + chunk)[-BUFFERED:]

    def text(self) -> str:
        self.join(timeout=1.0)  # a process that left the process group may keep the stream open
        text = one_line(redact(self.content.decode("utf-8", errors="replace"))[-TAIL:])
        return f"; its output ends with: {text}" if text else ""
