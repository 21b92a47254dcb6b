"""Places in the code of a user, for messages about errors."""

from __future__ import annotations

import site
import sysconfig
import traceback
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent

PROBLEMS = PACKAGE / "problems"
"""The shipped problems, whose code is treated like a problem of a user."""

LIBRARIES = tuple(
    Path(path).resolve()
    for path in (PACKAGE, sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"), *site.getsitepackages())
)
"""Folders whose code is not the user's."""


def users_frames(error: BaseException) -> list[traceback.FrameSummary]:
    """The frames of a traceback outside this package and the libraries, the innermost last."""
    return [frame for frame in traceback.extract_tb(error.__traceback__) if is_users(frame.filename)]


def is_users(file: str) -> bool:
    """Whether a file exists and belongs to the user, and not to this package or a library."""
    path = Path(file).resolve()
    if not path.is_file():
        return False
    return path.is_relative_to(PROBLEMS) or not any(path.is_relative_to(folder) for folder in LIBRARIES)
