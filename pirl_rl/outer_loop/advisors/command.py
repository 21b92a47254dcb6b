"""Any program as an advisor: it reads a prompt file and writes a plan file. So a coding agent is plugged in."""

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
from pirl_rl.outer_loop.prompt import asked
from pirl_rl.outer_loop.redaction import redact

TAIL = 2_000
"""Characters of a failed program's output that the error quotes."""

KEPT = 16 * TAIL
"""Bytes of that output in memory: more than are quoted, so that a secret that is cut at their start is not."""


class Command:
    """Runs a program, without a shell, in the round's folder: scripts among its arguments need absolute paths.

    Args:
        command: its line, as in "my_agent --quiet {prompt} {plan}"; {prompt} and {plan} become paths of files, also
            inside an argument. The program's output is ignored, but for its end where it fails.
        timeout: seconds, after which it and all that it started are killed.
    """

    def __init__(self, command: str, timeout: float = 600.0):
        try:
            self.arguments = shlex.split(command)
        except ValueError as error:
            raise ArgumentError(f"command: expected a program and its arguments, got {command!r} ({error})") from None
        if not any("{plan}" in argument for argument in self.arguments):
            raise ArgumentError(f"command: expected {{plan}}, the file that the program is to write, in {command!r}")
        program = shutil.which(self.arguments[0])
        if program is None:
            raise ArgumentError(f"command: there is no program {self.arguments[0]}")
        if not timeout > 0:
            raise ArgumentError(f"timeout: expected seconds > 0, got {timeout}")
        self.arguments[0], self.timeout = str(Path(program).absolute()), timeout

    def propose(self, request: Request) -> str:
        attempt = 2 if request.errors else 1
        prompt, plan = (request.folder / f"advisor-{attempt}-{name}" for name in ("prompt.md", "plan.json"))
        try:
            plan.unlink(missing_ok=True)  # of a round that was killed and is asked again
            prompt.unlink(missing_ok=True)
            prompt.write_text(redact(asked(request)), encoding="utf-8")
        except OSError as error:
            raise AdvisorError(f"command: {error.filename}: {error.strerror}") from None
        files = {"{prompt}": str(prompt.absolute()), "{plan}": str(plan.absolute())}
        line = [re.sub(r"\{prompt\}|\{plan\}", lambda found: files[found[0]], text) for text in self.arguments]
        try:
            _run(line, request.folder, self.timeout)
            return read_answer(plan)
        finally:
            for path in (prompt, plan):  # what was said is on record, without the secrets that a program may tell
                with contextlib.suppress(OSError):
                    path.unlink()


def _run(line: Sequence[str], folder: Path, timeout: float) -> None:
    """Run to the end, and kill what is left of its process group.

    Raises:
        AdvisorError: it cannot be started, takes too long or fails.
    """
    try:
        process = subprocess.Popen(
            line,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        raise AdvisorError(f"command: {line[0]} cannot be started: {error}") from None
    assert process.stdout is not None
    tail = _Tail(process.stdout)
    reason = ""
    try:
        if process.wait(timeout):
            reason = f"{line[0]} ended with exit code {process.returncode}"
    except subprocess.TimeoutExpired:
        reason = f"{line[0]} took longer than {timeout:g} s"
    finally:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if reason:
        raise AdvisorError(f"command: {reason}{tail.text()}")


class _Tail(threading.Thread):
    """Reads a stream to its end, or as long as anyone holds it, and keeps what came last."""

    def __init__(self, stream: IO[bytes]):
        super().__init__(daemon=True)
        self.stream, self.content = stream, b""
        self.start()

    def run(self) -> None:
        with self.stream:
            while chunk := os.read(self.stream.fileno(), 65_536):
                self.content = (self.content + chunk)[-KEPT:]

    def text(self) -> str:
        self.join(timeout=1.0)  # a process that left the group may hold the stream open
        text = one_line(redact(self.content.decode("utf-8", errors="replace"))[-TAIL:])
        return f"; its output ends with: {text}" if text else ""
