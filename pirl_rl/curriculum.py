"""A curriculum: stages of training, each with its own starts of episodes, loss schedule and collocation."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import accumulate

from pirl_rl.actor_rules import ActorRule
from pirl_rl.errors import ArgumentError
from pirl_rl.sampling.collocation import Collocation
from pirl_rl.sampling.initial_states import InitialStates
from pirl_rl.schedules import Schedule, Weights


@dataclass(frozen=True, eq=False)
class Settings:
    """What a stage may set beside the loss weights; see `Stage`."""

    initial_states: InitialStates
    collocation: Collocation
    n_steps: int
    actor_every: int
    model_steps: int
    actor_rule: ActorRule
    exploration_noise: float
    learning_rate: float
    train_actor: bool = True


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage; what is None stays as the run has it.

    Attributes:
        updates: its length, in the unit of all stages: a run of another length stretches them all.
        schedule: loss weights by the stage's own updates, from 0.
        initial_states: law of the starts.
        collocation: sampler of the interior points.
        n_steps: length of returns.
        actor_every: critic updates for each update of the actor and the targets.
        model_steps: control steps that the actor's rule "model" looks ahead.
        actor_rule: of the actor.
        exploration_noise: deviation of the noise on played actions; where it changes, the replay buffer starts anew.
        learning_rate: a rate of its own, which decays over the stage as the run's does over the run.
        train_actor: False freezes the actor, so that the critics come to rest at the value of one policy.
    """

    updates: float
    schedule: Schedule | None = None
    initial_states: InitialStates | None = None
    collocation: Collocation | None = None
    n_steps: int | None = None
    actor_every: int | None = None
    model_steps: int | None = None
    actor_rule: ActorRule | None = None
    exploration_noise: float | None = None
    learning_rate: float | None = None
    train_actor: bool = True

    def __post_init__(self):
        if not self.updates > 0:
            raise ArgumentError(f"stage.updates: expected a number > 0, got {self.updates}")
        for name in ("n_steps", "actor_every", "model_steps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ArgumentError(f"stage.{name}: expected at least 1, got {value}")
        if self.exploration_noise is not None and not self.exploration_noise >= 0:
            raise ArgumentError(f"stage.exploration_noise: expected a number >= 0, got {self.exploration_noise}")
        if self.learning_rate is not None and not self.learning_rate > 0:
            raise ArgumentError(f"stage.learning_rate: expected a number > 0, got {self.learning_rate}")

    def over(self, run: Settings) -> Settings:
        """This stage's settings, the run's where it has none."""
        own = {field.name: getattr(self, field.name) for field in fields(Settings)}
        return replace(run, **{name: value for name, value in own.items() if value is not None})


class Curriculum:
    """Stages one after another, stretched to the length of the run; a `Schedule` itself.

    Args:
        schedule: of the stages that have none, by the run's updates.
        updates: length of the run.
        stages: at least one.
    """

    def __init__(self, schedule: Schedule, updates: int, stages: Sequence[Stage] = (Stage(1.0),)):
        if not stages:
            raise ArgumentError("curriculum.stages: expected at least one stage, got none")
        self.schedule, self.stages, self._updates = schedule, tuple(stages), updates
        self._before = [0.0, *accumulate(stage.updates for stage in stages)]
        self._stretch = updates / self._before.pop()
        # Rounding of the stretch is not to shift a stage by one update.
        self._starts = [math.ceil(before * self._stretch - 1e-6) for before in self._before]

    def index(self, update: int) -> int:
        """The stage of an update; the last one goes on for ever."""
        return bisect_right(self._starts, update) - 1

    def begins(self, update: int) -> bool:
        """Whether a stage begins with this update."""
        return update in self._starts

    def course(self, update: int) -> float:
        """How far the learning rate's course is: a fraction of the run, or of a stage with a rate of its own."""
        index = self.index(update)
        if self.stages[index].learning_rate is None:
            return update / self._updates
        begin, end = [*self._starts, self._updates][index : index + 2]
        return (update - begin) / (end - begin)

    def __call__(self, update: int) -> Weights:
        schedule, own = self._schedule(update)
        return schedule(own)

    def progress(self, update: int) -> float:
        schedule, own = self._schedule(update)
        return schedule.progress(own)

    def _schedule(self, update: int) -> tuple[Schedule, float]:
        """The schedule of an update's stage, and the update in that schedule's own count."""
        index = self.index(update)
        schedule = self.stages[index].schedule
        return (self.schedule, update) if schedule is None else (schedule, update / self._stretch - self._before[index])
