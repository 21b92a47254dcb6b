"""An advisor that reads plans from a file, or replays those of an earlier loop."""

from __future__ import annotations

import json
from pathlib import Path

from pirl_rl.errors import AdvisorError, ArgumentError
from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.advisors.answer import read_answer
from pirl_rl.outer_loop.parsing import MAX_ANSWER

MAX_FILE = 10 * MAX_ANSWER
"""Largest number of bytes of a file with plans."""


class File:
    """Reads the plan of each round from a file. The file is read in every round, so that it may be edited in between.

    Args:
        path: a JSON file with the plan of the first round or with a list of plans, one for each round; or the directory
            of an earlier loop, whose plans are replayed.

    Raises:
        ArgumentError: if the path does not exist.
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
            return text  # `parse_plan` refuses it and gives the reasons
        plans = content if isinstance(content, list) else [content]
        if request.number > len(plans):
            raise AdvisorError(f"{self.path.name}: no plan for round {request.number}, it has {len(plans)}")
        return json.dumps(plans[request.number - 1])
