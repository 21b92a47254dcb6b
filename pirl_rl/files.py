"""Files: written atomically, so that a reader finds the complete file or none, and folders that are removed."""

from __future__ import annotations

import contextlib
import glob
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

ABANDONED = 3_600
"""The age in seconds from which a draft belongs to a writer that was killed, and is removed by the next one."""


@contextlib.contextmanager
def replacing(path: Path, binary: bool = False) -> Iterator[IO[Any]]:
    """Open a draft for writing, and put it in the place of `path` at the end of the block, flushed to disk.

    If the block raises, the draft is removed and the file at `path` stays as it was. Each draft is a new file with
    a name of its own, so that no symbolic link under its name is followed, and several processes may write one file.

    Args:
        path: the file to write; missing directories are made.
        binary: whether bytes are written, in place of UTF-8 text.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for old in path.parent.glob(f".{glob.escape(path.name)}.*.draft"):
        with contextlib.suppress(OSError):  # another process may have removed it
            if time.time() - old.lstat().st_mtime > ABANDONED:
                old.unlink()
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.draft")
    try:
        with draft.open("xb") if binary else draft.open("x", newline="", encoding="utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def remove_folder(folder: Path) -> None:
    """Remove a directory with all that it holds, and two levels above it if they are empty and below the current one.

    The current directory and those above it stay. So does a directory that cannot be removed, such as a mount point.
    """
    here = Path.cwd()
    for path in folder.iterdir():
        with contextlib.suppress(OSError):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    above = [path for path in (folder.parent, folder.parent.parent) if here in path.absolute().parents]
    for path in (folder, *above):
        if path.absolute() not in (here, *here.parents):
            with contextlib.suppress(OSError):
                path.rmdir()  # fails for a folder that is not empty
