"""Advisors plan a round's candidates from the record of the rounds before; `parse_plan` judges what they answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pirl_rl.outer_loop.history import History


@dataclass(frozen=True)
class Request:
    """What a round asks.

    Attributes:
        number: of the round, from 1.
        candidates: how many the plan must have.
        updates: length of each.
        history: baseline and finished rounds.
        prompt: the same in words, for advisors that read.
        folder: for files of this asking; removed after the answer.
        errors: what was wrong with the answer before, on the second time of asking.
    """

    number: int
    candidates: int
    updates: int
    history: History
    prompt: str
    folder: Path
    errors: Sequence[str] = ()


class Advisor(Protocol):
    """Anything that plans. The same request gets the same answer where an advisor can promise that."""

    def propose(self, request: Request) -> str:
        """The answer, the JSON of a `Plan` if all is well.

        Raises:
            AdvisorError: no answer: a time-out, a crash, a server's error.
        """
        ...
