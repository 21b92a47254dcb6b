"""What comes from outside: answers that lie in files, and texts that messages quote."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from pirl_rl.errors import AdvisorError
from pirl_rl.outer_loop.parsing import MAX_ANSWER


def read_answer(path: Path, limit: int = MAX_ANSWER) -> str:
    """The text of a regular file; no link is followed and no pipe waited for.

    Args:
        limit: bytes; a longer file is refused unread.

    Raises:
        AdvisorError: there is no such file, or it is none of these.
    """
    try:
        with open(path, "rb", opener=_regular) as file:
            content = file.read(limit + 1)
    except OSError as error:
        raise AdvisorError(f"{path.name}: cannot be read: {error.strerror}") from None
    if len(content) > limit:
        raise AdvisorError(f"{path.name}: expected at most {limit:,} bytes, got more")
    return content.decode("utf-8", errors="replace")


def _regular(path: str, flags: int) -> int:
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file")
    return descriptor


def one_line(text: str) -> str:
    """A text without line breaks and terminal codes."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())
