"""The prompt: a template of `conf`, the user's context and the record so far, for advisors that read."""

from __future__ import annotations

import json
import re
from pathlib import Path

from jinja2 import StrictUndefined
from jinja2.sandbox import SandboxedEnvironment

from pirl_rl.configuration import CONF
from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.history import History
from pirl_rl.outer_loop.plan import START, Plan

TEMPLATE = CONF / "prompt.md.j2"


def render(
    history: History,
    *,
    rounds: int,
    candidates: int,
    updates: int,
    context: str = "",
    template: Path = TEMPLATE,
) -> str:
    """What a round asks, in words.

    Args:
        history: baseline and finished rounds; goes in as JSON.
        rounds: of the loop; with `updates` they are the milestone.
        candidates: that the plan must have.
        updates: length of each.
        context: the user's own words, put in as they are.
        template: its source, Jinja2.

    Raises:
        OSError, jinja2.TemplateError: a template that cannot be read or rendered.
    """
    environment = SandboxedEnvironment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    return environment.from_string(template.read_text(encoding="utf-8")).render(
        number=len(history.rounds) + 1,
        candidates=candidates,
        updates=updates,
        milestone=rounds * updates,
        start=START,
        best=history.best.checkpoint,
        checkpoints=list(history.checkpoints),
        schema=json.dumps(Plan.model_json_schema(), indent=1),
        results=history.model_dump_json(indent=1, exclude_none=True),
        context=context,
        fence=_fence(context),
    )


def asked(request: Request) -> str:
    """A request's prompt and, on the second time of asking, what was wrong with the answer before."""
    if not request.errors:
        return request.prompt
    errors = "\n".join(f"- {' '.join(error.split())}" for error in request.errors)
    return (
        f"{request.prompt}\n## Your last answer was refused\n\nIt was no valid plan, for these reasons:\n\n{errors}\n\n"
        "Answer again with the whole plan, mended.\n"
    )


def _fence(text: str) -> str:
    """A Markdown fence that the text cannot close."""
    return "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))
