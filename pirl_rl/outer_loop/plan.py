"""What an advisor answers: a round's candidates; the field names are those of the paper's appendix on scheduling."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

START = "start"
"""Names the checkpoint that the whole loop starts from; others are "<round>/<candidate>"."""

Weight = Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)]
Triple = tuple[Weight, Weight, Weight]


class Frozen(BaseModel):
    """Immutable, with no fields but its own and no infinite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Candidate(Frozen):
    """One continuation.

    Attributes:
        name: letters a-z, digits, - and _; unique in its round.
        start_checkpoint: the name of a checkpoint of the history, from which the candidate goes on.
        schedule_initial, schedule_final: weights (TD, HJB, boundary) at both ends of the sigmoid.
        schedule_center: the middle of the sigmoid, in updates of this candidate.
        schedule_sharpness: the rate of the sigmoid, 1/update.
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


class Plan(Frozen):
    """A round's candidates and why."""

    round_note: Annotated[str, Field(max_length=4_000)]
    candidates: Annotated[list[Candidate], Field(min_length=1)]
