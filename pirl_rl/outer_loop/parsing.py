"""The check that turns an advisor's answer into a plan.

An answer is text from outside, and only the `Plan` that `parse_plan` reads from it is used. The names in it can serve
as directory names; its checkpoints are looked up in the history and never read as paths.
"""

from __future__ import annotations

import json
import re

from pydantic import ValidationError

from pirl_rl.errors import PlanError
from pirl_rl.outer_loop.history import History
from pirl_rl.outer_loop.plan import START, Plan

MAX_ANSWER = 200_000
"""Largest number of characters of an answer."""


def parse_plan(answer: str, history: History, count: int) -> Plan:
    """The plan in an answer: a JSON object, alone or in one fenced block.

    Args:
        answer: the text of the advisor.
        history: the checkpoints from which the plan may start, and the candidates that it must not repeat.
        count: the number of candidates that the plan must have.

    Raises:
        PlanError: with all reasons for which the answer is no valid plan.
    """
    if len(answer) > MAX_ANSWER:
        raise PlanError([f"answer: expected at most {MAX_ANSWER:,} characters, got {len(answer):,}"])
    fenced = re.fullmatch(r"\s*```(?:json)?\s*\n(.*)\n```\s*", answer, re.DOTALL)
    try:
        plan = Plan.model_validate(json.loads(fenced[1] if fenced else answer))
    except ValidationError as error:
        raise PlanError([_describe_error(detail) for detail in error.errors()[:20]]) from None
    except (ValueError, RecursionError) as error:  # Python raises a ValueError for an integer of too many digits too
        raise PlanError([f"answer: expected one JSON object, got text that is no JSON: {error}"]) from None
    errors = [*_count_errors(plan, count), *_start_errors(plan, history), *_repeat_errors(plan, history)]
    if errors:
        raise PlanError(errors)
    return plan


def _describe_error(detail) -> str:
    place = ".".join(str(part) for part in detail["loc"]) or "answer"
    return f"{place}: {detail['msg']}, got {repr(detail['input'])[:80]}"


def _count_errors(plan: Plan, count: int) -> list[str]:
    names = [candidate.name for candidate in plan.candidates]
    repeated = [name for name in sorted(set(names)) if names.count(name) > 1]
    errors = [f"candidates: expected different names, got {name} more than once" for name in repeated]
    if len(names) != count:
        errors.append(f"candidates: expected exactly {count}, got {len(names)}")
    return errors


def _start_errors(plan: Plan, history: History) -> list[str]:
    known = history.checkpoints
    errors = []
    for candidate in plan.candidates:
        start = known.get(candidate.start_checkpoint)
        if start is None:
            offered = ", ".join(known)
            errors.append(
                f"{candidate.name}.start_checkpoint: expected one of {offered}, got {candidate.start_checkpoint[:80]!r}"
            )
            continue
        for name in ("collocation_jitter", "collocation_replay_share"):
            if getattr(candidate, name) is not None and getattr(start, name) is None:
                errors.append(f"{candidate.name}.{name}: the run's collocation has no such setting, leave it out")
    restarts = [candidate.name for candidate in plan.candidates if candidate.start_checkpoint == START]
    if len(restarts) > 1 and any(history.keeps(result) for result in history.results):
        errors.append(f"candidates: expected at most restart from {START!r}, as sound results exist, got {restarts}")
    return errors


def _repeat_errors(plan: Plan, history: History) -> list[str]:
    """Candidates that repeat a combination of start, weights and jitter, unless the round's note names them."""
    before = {result.candidate.settings for result in history.results if result.candidate is not None}
    return [
        f"{candidate.name}: repeats an earlier combination of start, weights and jitter; change it, or say why in "
        f"round_note, naming {candidate.name}"
        for candidate in plan.candidates
        if candidate.settings in before and candidate.name not in plan.round_note
    ]
