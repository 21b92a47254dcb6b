"""The prompt of a round, for advisors that read text: a template of `conf`, the user's context and the history."""

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
    """Render the prompt of the next round.

    Args:
        history: the baseline and the finished rounds, which the prompt contains as JSON.
        rounds: number of rounds of the loop; `rounds * updates` is the milestone.
        candidates: number of candidates that the plan must have.
        updates: number of updates of each candidate.
        context: the user's text, which the prompt contains unchanged.
        template: file of the Jinja2 template.

    Raises:
        OSError: if the template cannot be read.
        jinja2.TemplateError: if the template cannot be rendered.
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


def request_text(request: Request) -> str:
    """The prompt of a request and, if an earlier answer was refused, the reasons."""
    if not request.errors:
        return request.prompt
    errors = "\n".join(f"- {' '.join(error.split())}" for error in request.errors)
    return (
        f"{request.prompt}\n## Your last answer was refused\n\nIt was no valid plan, for these reasons:\n\n{errors}\n\n"
        "Answer again with the whole corrected plan.\n"
    )


def _fence(text: str) -> str:
    """A Markdown fence that the text cannot close."""
    return "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))
