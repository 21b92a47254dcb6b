"""Errors that a user can correct: the message says what was expected and what was got, so no traceback is shown."""

from __future__ import annotations

INTERRUPTED = 130
"""Exit code of a command that was interrupted and can be resumed: 128 plus the number of SIGINT, as in shells."""


class PirlError(Exception):
    """The base class of all errors of this package."""


class ArgumentError(PirlError, ValueError):
    """A constructor or a function refuses an argument; the message names it."""


class ConfigError(PirlError, ValueError):
    """Nothing can be built from a configuration; the message names the key."""


class ProblemError(PirlError, ValueError):
    """A problem is incomplete or contradicts itself; the message names the part."""


class CheckpointError(PirlError, RuntimeError):
    """A checkpoint is missing, broken or of another configuration; the message names the file."""


class CollectorError(PirlError, RuntimeError):
    """A rollout worker did not start, died or delivered nothing; the message says which."""


class ClusterError(PirlError, RuntimeError):
    """Ray is not installed, or its cluster cannot be reached; the message names the setting or the address."""


class DivergenceError(PirlError, RuntimeError):
    """A loss or a parameter became NaN or infinite, or a loss exploded; the message names the update and the term."""


class CollapseError(DivergenceError):
    """An evaluation fell below the baseline by more than its noise; the message gives the metrics before and after."""


class RunError(PirlError, ValueError):
    """A run directory cannot be read or compared, or another process holds it; the message names the path."""


class PlanError(PirlError, ValueError):
    """The answer of an advisor is not a valid plan.

    Attributes:
        errors: the reasons, one line each.
    """

    def __init__(self, errors):
        super().__init__("; ".join(errors))
        self.errors = list(errors)


class AdvisorError(PirlError, RuntimeError):
    """An advisor gave no answer; the message says why and contains no API key."""


class ProofError(PirlError, ValueError):
    """Nothing can be proved, because a function or a problem is beyond the method; the message says which and why."""


class Interrupted(PirlError):
    """A user stopped training, whose state is saved.

    Attributes:
        update: the number of updates that were made.

    Args:
        update: the same.
        folder: the run directory, for the message of a call that may not know its name.
    """

    def __init__(self, update: int, folder: object = None):
        super().__init__(
            f"stopped at update {update}" + ("" if folder is None else f"; the run in {folder} can be resumed")
        )
        self.update = update
