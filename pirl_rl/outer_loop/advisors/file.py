"""A person's plans, or the replay of an earlier loop's."""

from __future__ import annotations

import json
from pathlib import Path

from pirl_rl.errors import AdvisorError, ArgumentError
from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.advisors.answer import read_answer
from pirl_rl.outer_loop.parsing import MAX_ANSWER

MAX_FILE = 10 * MAX_ANSWER


class File:
    """Plans written before; read anew each round, so that they may be edited in between.

    Args:
        path: a JSON file with one plan, which is the first round's, or with a list of plans, round by round; or the
            output directory of an earlier loop, whose rounds are replayed.
    """

    def __init__(self, path: str):
        self.path = Path(path).absolute()
        if not self.path.exists():
            raise ArgumentError(f"path: expected a file with plans or a loop's directory, got {path}")

    def propose(self, request: Request) -> str:
        if self.path.is_dir():
            return read_answer(self.path / "rounds" / f"{request.number:03d}" / "plan.json")
        text = read_answer(self.path.resolve(), MAX_FILE)
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            return text  # which the reader of plans refuses, with its reasons
        plans = content if isinstance(content, list) else [content]
        if request.number > len(plans):
            raise AdvisorError(f"{self.path.name}: no plan for round {request.number}, it has {len(plans)}")
        return json.dumps(plans[request.number - 1])
