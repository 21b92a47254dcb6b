"""Advisors, which plan the candidates of a round from the history; `parse_plan` checks their answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pirl_rl.outer_loop.history import History


@dataclass(frozen=True)
class Request:
    """A request for the plan of a round.

    Attributes:
        number: number of the round, from 1.
        candidates: number of candidates that the plan must have.
        updates: number of updates of each candidate's training.
        history: the baseline and the finished rounds.
        prompt: the request as text, for advisors that read text.
        folder: a folder for temporary files, which is removed after the answer.
        errors: why the previous answer to this request was refused; empty at the first attempt.
    """

    number: int
    candidates: int
    updates: int
    history: History
    prompt: str
    folder: Path
    errors: Sequence[str] = ()


class Advisor(Protocol):
    """Plans the rounds of an outer loop."""

    def propose(self, request: Request) -> str:
        """Answer a request with the JSON of a `Plan`.

        Raises:
            AdvisorError: if there is no answer, for example because of a time-out or a crash.
        """
        ...
