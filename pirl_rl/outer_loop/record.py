"""The record of a loop: the files of its directory, which hold its whole state.

out/ tune.yaml context.md baseline.json tree.png report.md
     rounds/NNN/ prompt.md answer.json plan.json results.json
     rounds/NNN/candidates/ <name>/ <name>.log population.log
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from pirl_rl.errors import ConfigError
from pirl_rl.files import replacing
from pirl_rl.outer_loop.history import History, Result, Round
from pirl_rl.outer_loop.plan import Plan
from pirl_rl.outer_loop.redaction import redact

CONTEXT = (
    "<!-- Write here what the advisor should know. The file is read before every round; comments like this one are not "
    "passed on. -->\n"
)
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)

T = TypeVar("T")


class Attempt(BaseModel):
    """An attempt to get a plan.

    Attributes:
        advisor: name of the advisor that was asked.
        answer: its answer.
        errors: why the answer is no valid plan; empty if it is the round's plan.
    """

    advisor: str
    answer: str
    errors: list[str] = []


class Record:
    """Reads and writes the files of a loop.

    Each file is written completely or not at all, without the values of secret environment variables.

    Args:
        out: directory of the loop.
    """

    def __init__(self, out: Path):
        self.out = out

    def folder(self, number: int) -> Path:
        """The directory of a round."""
        return self.out / "rounds" / f"{number:03d}"

    def candidates(self, number: int) -> Path:
        """The directory with the runs of a round's candidates."""
        return self.folder(number) / "candidates"

    def run(self, checkpoint: str) -> Path:
        """The run directory of a checkpoint "<round>/<candidate>" of the history."""
        number, _, name = checkpoint.partition("/")
        return self.candidates(int(number)) / name

    def baseline(self) -> Result | None:
        return _read(self.out / "baseline.json", Result)

    def write_baseline(self, baseline: Result) -> None:
        _write(self.out / "baseline.json", baseline.model_dump())

    def history(self, baseline: Result, tolerance: float) -> History:
        """All finished rounds."""
        rounds: list[Round] = []
        while (one := _read(self.folder(len(rounds) + 1) / "results.json", Round)) is not None:
            rounds.append(one)
        return History(baseline=baseline, rounds=rounds, tolerance=tolerance)

    def write_round(self, one: Round) -> None:
        _write(self.folder(one.number) / "results.json", one.model_dump())

    def context(self) -> str:
        """The user's text for the advisor, read from context.md, which is created if it does not exist."""
        path = self.out / "context.md"
        if not path.exists():
            with replacing(path) as file:
                file.write(CONTEXT)
        return COMMENT.sub("", path.read_text(encoding="utf-8", errors="replace")).strip()

    def prompt(self, number: int) -> str | None:
        path = self.folder(number) / "prompt.md"
        return path.read_text(encoding="utf-8") if path.exists() else None

    def write_prompt(self, number: int, text: str) -> None:
        with replacing(self.folder(number) / "prompt.md") as file:
            file.write(redact(text))

    def attempts(self, number: int) -> list[Attempt]:
        return _read(self.folder(number) / "answer.json", list[Attempt]) or []

    def write_attempts(self, number: int, attempts: list[Attempt]) -> None:
        _write(self.folder(number) / "answer.json", [attempt.model_dump() for attempt in attempts])

    def plan(self, number: int) -> Plan | None:
        return _read(self.folder(number) / "plan.json", Plan)

    def write_plan(self, number: int, plan: Plan) -> None:
        _write(self.folder(number) / "plan.json", plan.model_dump())


def _write(path: Path, data: Any) -> None:
    with replacing(path) as file:
        file.write(json.dumps(redact(data), indent=2, allow_nan=False) + "\n")


def _read(path: Path, kind: type[T]) -> T | None:
    """Read a file as an object of a type; None if there is no file.

    Raises:
        ConfigError: if the file does not hold such an object.
    """
    if not path.exists():
        return None
    try:
        return TypeAdapter(kind).validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ConfigError(
            f"{path}: {place}: {first['msg']}; correct the file, or remove it to repeat its part of the loop"
        ) from None
