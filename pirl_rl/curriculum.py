"""Curricula: a list of stages of training, each with its own initial states, loss weights, samplers and actor rule."""

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
class StageSettings:
    """The settings in force during a stage, apart from the loss weights; see `Stage` for their meanings."""

    initial_states: InitialStates
    collocation: Collocation
    n_steps: int
    actor_every: int
    actor_rule: ActorRule
    exploration_noise: float
    learning_rate: float
    train_actor: bool = True


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage of training. Attributes that are None take the settings of the run.

    Attributes:
        share: the length of the stage relative to those of the other stages, which together fill the run.
        schedule: the loss weights; it counts updates from the start of the stage.
        initial_states: the distribution of the initial states of episodes.
        collocation: the sampler of the interior points.
        n_steps: the length of returns, in control steps.
        actor_every: the number of critic updates for each update of the actor and the target networks.
        actor_rule: the objective that the actor ascends.
        exploration_noise: standard deviation of the noise on played actions, which are normalised to [-1, 1]. Where it
            changes, the replay buffer is emptied, since its actions come from another policy.
        learning_rate: the initial learning rate; it decays over the stage. That of the run decays over the run.
        train_actor: False freezes the actor, so that the critics learn the value of one fixed policy. An actor that
            the stage before has trained is frozen at its target network, a mean over the last updates.

    Raises:
        ArgumentError: a number is out of range.
    """

    share: float = 1.0
    schedule: Schedule | None = None
    initial_states: InitialStates | None = None
    collocation: Collocation | None = None
    n_steps: int | None = None
    actor_every: int | None = None
    actor_rule: ActorRule | None = None
    exploration_noise: float | None = None
    learning_rate: float | None = None
    train_actor: bool = True

    def __post_init__(self):
        if not self.share > 0:
            raise ArgumentError(f"stage.share: expected a number > 0, got {self.share}")
        for name in ("n_steps", "actor_every"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ArgumentError(f"stage.{name}: expected at least 1, got {value}")
        if self.exploration_noise is not None and not self.exploration_noise >= 0:
            raise ArgumentError(f"stage.exploration_noise: expected a number >= 0, got {self.exploration_noise}")
        if self.learning_rate is not None and not self.learning_rate > 0:
            raise ArgumentError(f"stage.learning_rate: expected a number > 0, got {self.learning_rate}")

    def over(self, run: StageSettings) -> StageSettings:
        """The settings of this stage, completed by those of the run."""
        own = {field.name: getattr(self, field.name) for field in fields(StageSettings)}
        return replace(run, **{name: value for name, value in own.items() if value is not None})


class Curriculum:
    """Stages one after another over the updates of a run.

    Args:
        schedule: the loss weights over the run, for stages without a schedule.
        updates: the number of updates of the run.
        stages: at least one stage.

    Raises:
        ArgumentError: there is no stage.
    """

    def __init__(self, schedule: Schedule, updates: int, stages: Sequence[Stage] = (Stage(),)):
        if not stages:
            raise ArgumentError("curriculum.stages: expected at least one stage, got none")
        self.schedule, self.stages, self.updates = schedule, tuple(stages), updates
        before = [0.0, *accumulate(stage.share for stage in stages)]
        stretch = updates / before.pop()
        # The tolerance keeps rounding errors of the product from shifting a stage by one update.
        self._firsts = [math.ceil(share * stretch - 1e-6) for share in before]

    def index(self, update: int) -> int:
        """The index of the stage of an update, counted from 0; the last stage has no end."""
        return bisect_right(self._firsts, update) - 1

    def is_first(self, update: int) -> bool:
        """Whether an update is the first of its stage."""
        return update in self._firsts

    def freezes(self, update: int) -> bool:
        """Whether an update is the first of a stage that freezes an actor which the stage before has trained."""
        trains = [self.stage(k).train_actor for k in (update - 1, update)] if update > 0 else []
        return self.is_first(update) and trains == [True, False]

    def stage(self, update: int) -> Stage:
        """The stage of an update."""
        return self.stages[self.index(update)]

    def weights(self, update: int) -> Weights:
        """The weights (w_TD, w_HJB, w_BC) at an update."""
        schedule, count, length = self._schedule(update)
        return schedule(count, length)

    def largest_weights(self) -> Weights:
        """The largest weight of each term over the run, looked up at about a thousand updates."""
        updates = (*range(0, self.updates, max(1, self.updates // 1_000)), self.updates)
        td, hjb, boundary = zip(*map(self.weights, updates), strict=True)
        return max(td), max(hjb), max(boundary)

    def progress(self, update: int) -> float:
        """The progress eta, in [0, 1], of the schedule that is in force at an update."""
        schedule, count, length = self._schedule(update)
        return schedule.progress(count, length)

    def decay(self, update: int) -> float:
        """The progress, in [0, 1], of the learning rate's decay: over the run, or over a stage that sets a rate."""
        if self.stage(update).learning_rate is None:
            return update / self.updates
        first, end = self._bounds(update)
        return (update - first) / max(end - first, 1)

    def _bounds(self, update: int) -> tuple[int, int]:
        """The first update of the stage of an update, and the first update after that stage."""
        index = self.index(update)
        first, end = [*self._firsts, self.updates][index : index + 2]
        return first, end

    def _schedule(self, update: int) -> tuple[Schedule, int, int]:
        """The schedule in force at an update, the update as the schedule counts it, and the length of the schedule."""
        own = self.stage(update).schedule
        if own is None:
            return self.schedule, update, self.updates
        first, end = self._bounds(update)
        return own, update - first, max(end - first, 1)
