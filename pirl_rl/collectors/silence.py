"""How long workers have delivered nothing."""

from __future__ import annotations

import time

LONGEST_GAP = 5.0
"""The most seconds between two looks that count as silence of the workers. In a longer gap the learner was busy, as
with an evaluation, or its machine slept, and it could not hear the workers."""


class Silence:
    """Counts the seconds in which nothing was delivered, from its making on."""

    def __init__(self):
        self._seconds, self._looked_at = 0.0, time.monotonic()

    def after(self, delivered: bool) -> float:
        """The length of the silence, in s, at another look; 0 if something was delivered since the last one."""
        now = time.monotonic()
        self._seconds = 0.0 if delivered else self._seconds + min(now - self._looked_at, LONGEST_GAP)
        self._looked_at = now
        return self._seconds
