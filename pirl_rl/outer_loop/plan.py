"""What an advisor is asked and what it answers, with the paper's field names (its appendix on scheduling by an agent).

An answer is text from outside. It becomes a `Plan` only through `parse_plan`; nothing else of it is ever used. Its
names are directory names, its checkpoints are looked up among those on offer and never read as paths.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

START = "start"
"""Names the checkpoint that the whole loop starts from; others are "<round>/<candidate>"."""

MAX_ANSWER = 200_000
"""Characters of the longest answer that is read."""

Weight = Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)]
Triple = tuple[Weight, Weight, Weight]


class PlanError(ValueError):
    """An answer that is no plan; `errors` says what is wrong, one line each."""

    def __init__(self, errors: Sequence[str]):
        super().__init__("; ".join(errors))
        self.errors = list(errors)


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Candidate(_Record):
    """One continuation.

    Attributes:
        name: letters a-z, digits, - and _; unique in its round.
        start_checkpoint: one of those on offer.
        schedule_initial, schedule_final: weights (TD, HJB, boundary) at both ends of the sigmoid.
        schedule_center: its middle, in updates of this candidate.
        schedule_sharpness: its rate, 1/update.
        collocation_jitter: deviation of the steps around visited states at the schedule's end, see `ReplayCollocation`;
            None keeps that of the start. It moves there from the start's value.
        collocation_replay_share: share of collocation points near visited states at the schedule's end; likewise.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
    start_checkpoint: str = START
    schedule_initial: Triple
    schedule_final: Triple
    schedule_center: Annotated[float, Field(ge=0, le=1e9)]
    schedule_sharpness: Annotated[float, Field(gt=0, le=10)]
    collocation_jitter: Annotated[float, Field(ge=0, le=1)] | None = None
    collocation_replay_share: Annotated[float, Field(ge=0, le=1)] | None = None

    @property
    def settings(self) -> tuple:
        """What the paper's prompt calls a combination."""
        return (self.start_checkpoint, self.schedule_initial, self.schedule_final, self.collocation_jitter)


class Plan(_Record):
    """A round's candidates and why."""

    round_note: Annotated[str, Field(max_length=4_000)]
    candidates: Annotated[list[Candidate], Field(min_length=1)]


class Result(_Record):
    """What became of a candidate, or of the start itself (`candidate` None).

    Attributes:
        checkpoint: the name under which later plans may start from it; None where there is nothing to start from.
        status: "done"; "collapsed", stopped by the guard and rolled back; "failed", ended with an error.
        updates: of the whole chain since the loop's start.
        metrics: of `summary.json`.
        weights: the loss weights (TD, HJB, boundary) in force at its end.
        collocation_jitter, collocation_replay_share: at its end, None where its collocation has none.
        reason: why it failed or collapsed.
    """

    checkpoint: str | None
    candidate: Candidate | None = None
    status: Literal["done", "collapsed", "failed"] = "done"
    updates: int = 0
    metrics: dict[str, float] = {}
    weights: Triple
    collocation_jitter: float | None = None
    collocation_replay_share: float | None = None
    reason: str = ""


class Round(_Record):
    """A finished round."""

    number: int
    advisor: str
    note: str
    fallback: str = ""  # why `advisor` had to step in for the one that was asked
    results: list[Result]


class History(_Record):
    """All that happened; what an advisor decides upon.

    Attributes:
        baseline: the loop's start, which no candidate may fall behind in reward.
        rounds: finished ones.
        tolerance: how much lower a reward may be before it counts as worse: its statistical noise.
    """

    baseline: Result
    rounds: list[Round] = []
    tolerance: float

    @property
    def results(self) -> list[Result]:
        return [result for one in self.rounds for result in one.results]

    @property
    def best(self) -> Result:
        """The lowest calibration_mae among those that are no worse than the baseline in reward."""
        sound = [self.baseline, *(result for result in self.results if self.keeps(result))]
        return min(sound, key=lambda result: result.metrics["calibration_mae"])

    def keeps(self, result: Result) -> bool:
        """Whether a result is sound: done, measured, and no worse than the baseline in reward by more than noise."""
        measured = result.checkpoint is not None and {"reward", "calibration_mae"} <= result.metrics.keys()
        least = self.baseline.metrics["reward"] - self.tolerance
        return result.status == "done" and measured and result.metrics["reward"] >= least

    @property
    def checkpoints(self) -> dict[str, Result]:
        """All that a plan may start from, by name."""
        return {one.checkpoint: one for one in (self.baseline, *self.results) if one.checkpoint is not None}


def parse_plan(answer: str, history: History, count: int) -> Plan:
    """The plan in an answer: a JSON object, alone or in one fenced block.

    Args:
        answer: any text.
        history: what the plan may start from and must not repeat.
        count: candidates that were asked for.

    Raises:
        PlanError: with every reason.
    """
    if len(answer) > MAX_ANSWER:
        raise PlanError([f"answer: expected at most {MAX_ANSWER:,} characters, got {len(answer):,}"])
    fenced = re.fullmatch(r"\s*```(?:json)?\s*\n(.*)\n```\s*", answer, re.DOTALL)
    try:
        plan = Plan.model_validate(json.loads(fenced[1] if fenced else answer))
    except ValidationError as error:
        raise PlanError([_told(detail) for detail in error.errors()[:20]]) from None
    except (ValueError, RecursionError) as error:  # also an integer of too many digits
        raise PlanError([f"answer: expected one JSON object, got no JSON: {error}"]) from None
    errors = [*_count_errors(plan, count), *_start_errors(plan, history), *_repeat_errors(plan, history)]
    if errors:
        raise PlanError(errors)
    return plan


def _told(detail) -> str:
    place = ".".join(str(part) for part in detail["loc"]) or "answer"
    return f"{place}: {detail['msg']}, got {repr(detail['input'])[:80]}"


def _count_errors(plan: Plan, count: int) -> list[str]:
    names = [candidate.name for candidate in plan.candidates]
    errors = [f"candidates: the name {name} stands twice" for name in sorted(set(names)) if names.count(name) > 1]
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
        errors.append(f"candidates: at most one may restart from {START!r} once others succeeded, got {restarts}")
    return errors


def _repeat_errors(plan: Plan, history: History) -> list[str]:
    """A combination of start, weights and jitter is run again only where the note says why, by the candidate's name."""
    before = {result.candidate.settings for result in history.results if result.candidate is not None}
    return [
        f"{candidate.name}: repeats an earlier combination of start, weights and jitter; change it, or say why in "
        f"round_note, naming {candidate.name}"
        for candidate in plan.candidates
        if candidate.settings in before and candidate.name not in plan.round_note
    ]
