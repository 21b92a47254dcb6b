"""Plans of an outer loop. The names of the fields are those of the paper's appendix on scheduling."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

START = "start"
"""The name of the checkpoint from which the loop starts; the names of others are "<round>/<candidate>"."""

Weight = Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)]
Triple = tuple[Weight, Weight, Weight]


class Frozen(BaseModel):
    """An immutable model without unknown fields and without infinite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Candidate(Frozen):
    """A continued training with a schedule of the loss weights, Eq. (weight_scheduling), and of the collocation.

    Attributes:
        name: letters a-z, digits, - and _; unique in its round.
        start_checkpoint: the name of a checkpoint of the history, from which the candidate continues.
        schedule_initial: loss weights (TD, HJB, boundary) before the transition.
        schedule_final: loss weights (TD, HJB, boundary) after the transition.
        schedule_center: the center of the sigmoid, in updates of this candidate.
        schedule_sharpness: the steepness of the sigmoid, in 1/update.
        collocation_jitter: the jitter after the transition, see `ReplayCollocation`; None keeps that of the start.
        collocation_replay_share: the share of collocation points near visited states after the transition; None keeps
            that of the start.
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
        """The combination of settings that no later candidate should repeat, as the paper's prompt defines it."""
        return (self.start_checkpoint, self.schedule_initial, self.schedule_final, self.collocation_jitter)


class Plan(Frozen):
    """The candidates of a round, with a note on the reasons."""

    round_note: Annotated[str, Field(max_length=4_000)]
    candidates: Annotated[list[Candidate], Field(min_length=1)]
