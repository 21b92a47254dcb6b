"""What a diagnostic says: numbers about V that bound nothing."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Diagnostic:
    """Numbers that rest on estimates, on which no reader may rely as on those of a `Claim`.

    Attributes:
        method: what was computed, and its source.
        sentences: what came out, in words.
        numbers: results by name; None where there is none.
        kind: tells a reader of the file that this is no claim.
    """

    method: str
    sentences: tuple[str, ...]
    numbers: dict[str, float | None]
    kind: str = "diagnostic"

    def to_dict(self) -> dict[str, Any]:
        """The diagnostic as plain values, for a JSON file."""
        return asdict(self) | {"sentences": [*self.sentences]}
