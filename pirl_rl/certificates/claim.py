"""What a statistical certificate claims, in numbers and in sentences."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple, Protocol

from pirl_rl.certificates.deployed import Deployed, Rngs, Starts


@dataclass(frozen=True)
class Claim:
    """A statement that is wrong with a probability of at most 1 - confidence, over the draws of starts and of noise.

    Attributes:
        bounded: what is bounded, in words.
        method: the name of the bound and its source.
        confidence: the level at which the claim holds alone.
        estimate: the estimate of what is bounded, without a margin; None if there is none.
        lower, upper: the bounds; None where that side is not bounded.
        samples: the number of independent draws that the bound rests on.
        paths: the number of paths that were played.
        holds: whether what was asked for is proved; True where nothing was asked for.
        sentences: what is claimed, how it was measured, and what it says about V.
        numbers: further results by name.
    """

    bounded: str
    method: str
    confidence: float
    estimate: float | None
    lower: float | None
    upper: float | None
    samples: int
    paths: int
    holds: bool
    sentences: tuple[str, str, str]
    numbers: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The claim as plain values, for a JSON file."""
        return asdict(self) | {"sentences": [*self.sentences]}


class Level(NamedTuple):
    """The confidence of a claim about a run that is the best of several on the same data.

    Each of the runs gets its share of the probability to err (C. E. Bonferroni, 1936), so that the bounds of all of
    them hold together, whichever is picked.

    Attributes:
        confidence: the level of the claim, in (0, 1).
        picked_from: the number of runs that were compared on the same data, 1 if none was.
    """

    confidence: float
    picked_from: int = 1

    @property
    def each(self) -> float:
        """The level of the bound of a single run."""
        return 1 - (1 - self.confidence) / self.picked_from

    def words(self) -> str:
        picked = f", corrected for the choice among {self.picked_from} runs" if self.picked_from > 1 else ""
        return f"With confidence {self.confidence:g}{picked},"


class Certifier(Protocol):
    """Measures and makes one claim."""

    def check(self, starts: Starts, level: Level) -> None:
        """Refuse before any path is played what can make no claim.

        Raises:
            ArgumentError: with the name of the argument.
        """
        ...

    def __call__(self, deployed: Deployed, starts: Starts, level: Level, rngs: Rngs) -> Claim:
        """The claim about a policy and its V."""
        ...
