"""Text from outside the package: answers in files, and text that messages quote."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from pirl_rl.errors import AdvisorError
from pirl_rl.outer_loop.parsing import MAX_ANSWER


def read_answer(path: Path, limit: int = MAX_ANSWER) -> str:
    """Read the text of a regular file; links are not followed, and pipes are not waited for.

    Args:
        path: the file.
        limit: largest number of bytes.

    Raises:
        AdvisorError: if there is no regular file, or it is longer than the limit.
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
    """Put a text on one line without control characters."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())
