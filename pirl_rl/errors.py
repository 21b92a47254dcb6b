"""Errors that are the user's to mend: their message says what was expected and what was got, and needs no traceback."""

from __future__ import annotations

INTERRUPTED = 130
"""Exit code of a command that was interrupted and can go on, as shells have it: 128 and the number of SIGINT."""


class PirlError(Exception):
    """Base of every error that this package raises on purpose."""


class ArgumentError(PirlError, ValueError):
    """An argument that a constructor or a function refuses; the message names it."""


class ConfigError(PirlError, ValueError):
    """A configuration that cannot be built; the message names the key, what was expected and what was got."""


class ProblemError(PirlError, ValueError):
    """A problem that contradicts itself; the message names the part and a point."""


class CheckpointError(PirlError, RuntimeError):
    """A checkpoint that is missing, broken or of another configuration; the message names the file."""


class CollectorError(PirlError, RuntimeError):
    """A rollout worker died or delivered nothing; the message names it."""


class DivergenceError(PirlError, RuntimeError):
    """A loss became NaN, infinite or exploded; the message names the update and the term."""


class CollapseError(DivergenceError):
    """An evaluation fell below the baseline by more than noise; the message names the metrics, before and after."""


class RunError(PirlError, ValueError):
    """Run directories that cannot be read or compared; the message names the path."""


class PlanError(PirlError, ValueError):
    """An advisor's answer that is no valid plan; `errors` holds the reasons, one line each."""

    def __init__(self, errors):
        super().__init__("; ".join(errors))
        self.errors = list(errors)


class AdvisorError(PirlError, RuntimeError):
    """An advisor gave no answer; the message says why and holds no key."""


class Interrupted(PirlError):
    """Training was asked to stop; everything is saved.

    Attributes:
        update: the last update that was made.
    """

    def __init__(self, update: int):
        super().__init__(f"stopped at update {update}")
        self.update = update
