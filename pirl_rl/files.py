"""Writing files atomically: a reader finds the complete file or none."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any


@contextmanager
def replacing(path: Path, binary: bool = False) -> Iterator[IO[Any]]:
    """Open a draft for writing, and put it in the place of `path` at the end of the block, flushed to disk.

    If the block raises, the draft is removed and the file at `path` stays as it was. The draft is always a new file, so
    that a symbolic link under its name is not followed.

    Args:
        path: the file to write; missing directories are made.
        binary: whether bytes are written, in place of UTF-8 text.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.draft")
    draft.unlink(missing_ok=True)
    try:
        with draft.open("xb") if binary else draft.open("x", newline="", encoding="utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
