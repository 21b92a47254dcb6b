"""A population: trainings of one problem side by side, with the losses of all members evaluated by one program.

The members differ in their seeds, in their loss weights or in their learning rates. Each is a whole `Trainer`, with an
environment, a replay buffer, optimisers, random numbers and a run directory of its own, so that its run equals the one
that it would have alone, up to rounding. An update stacks the networks and the batches of all members along a leading
axis, and `torch.func.vmap` maps the losses over that axis, so that they are compiled once and evaluated together. The
members play one after another, by one compiled simulator and one compiled policy.

On a GPU, where updates are recorded, they play together in one environment, see `pirl_rl.collectors.joint`. A run then
equals the one alone in law only, since the members share the random numbers of the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from pirl_rl import checkpoint
from pirl_rl.collectors import SyncCollector
from pirl_rl.collectors.joint import JointPlayer, share_program
from pirl_rl.errors import ArgumentError, DivergenceError, Interrupted
from pirl_rl.gradients import Terms
from pirl_rl.losses import TERMS
from pirl_rl.optimizers import step_together
from pirl_rl.progress import Progress, announce, interruptible
from pirl_rl.recording import Recordings
from pirl_rl.schedules import Weights
from pirl_rl.stacked_losses import StackedLosses
from pirl_rl.trainer import Trainer

PARTS: dict[str, Any] = dict(zip(TERMS, (("replay", "next"), "collocation", "boundary"), strict=True))
"""The part of a batch that each term of the critic loss needs."""


class Population:
    """Trains several trainers side by side.

    Attributes:
        errors: the errors by which trainings have ended, by the index of the member. The others go on.

    Args:
        members: the trainers, of one problem with the same networks, stages and number of updates.
        numbers: for each member the states of torch's random generators with which its training begins, see
            `pirl_rl.checkpoint.global_rng_states`.

    Raises:
        ArgumentError: there is no member, or the numbers of updates or the shapes of the networks differ.
    """

    def __init__(self, members: Sequence[Trainer], numbers: Sequence[dict[str, Any]]):
        kinds = {(one.updates, *(str(entry.shape) for entry in one.learner.loss.parameters())) for one in members}
        if len(kinds) != 1:
            raise ArgumentError("population: expected members with the same updates and networks of the same shapes")
        self.members, self._numbers = members, list(numbers)
        _share_programs(members)
        self.errors: dict[int, DivergenceError] = {}
        self._losses = StackedLosses(members[0].learner.gradients.compile)
        self._records = all(member.records for member in members)
        self._recordings = Recordings("an update", [rng for member in members for rng in member.generators])

    def train(self) -> list[dict[str, float] | None]:
        """Train all members to the last update and evaluate them.

        Returns:
            The summary of each member, or None if `errors` has one of it.

        Raises:
            Interrupted: on SIGINT, after a checkpoint of each member.
        """
        with self.members[0].products():
            with ExitStack() as opened, interruptible() as interrupted, _without_denormals():
                if joint := self._join():
                    opened.callback(joint.close)
                for index, member in enumerate(self.members):
                    with self._as_alone(index):
                        member.open()
                        opened.callback(member.close)
                        if not member.ended:
                            member.begin()
                announce("training")
                self._loop(interrupted)
            summaries: list[dict[str, float] | None] = [None] * len(self.members)
            for index, member in enumerate(self.members):
                if index not in self.errors:
                    with self._as_alone(index):
                        summaries[index] = member.finish()
            return summaries

    def _join(self) -> JointPlayer | None:
        """Let the members play together on a GPU; on a CPU this gains nothing."""
        collectors = [member.collector for member in self.members]
        if not self._records or not all(isinstance(one, SyncCollector) for one in collectors):
            return None
        joint = JointPlayer(collectors)  # type: ignore[arg-type]
        for index, collector in enumerate(collectors):
            collector.source = partial(joint.part, index)  # type: ignore[union-attr]
        return joint

    def _loop(self, interrupted: Callable[[], bool]) -> None:
        updates = self.members[0].updates
        # A population that was killed may have members with checkpoints of different updates.
        first = min((self.members[index].update for index in self._active()), default=updates)
        with Progress(updates, first) as progress:
            for k in range(first, updates):
                rows = self._update(k)
                names = min(rows, key=len, default={})
                progress.show(k + 1, {name: sum(row[name] for row in rows) / len(rows) for name in names})
                stopped = self._active() if interrupted() else []
                for index in stopped:
                    with self._as_alone(index):
                        self.members[index].keep(stop=True)
                if stopped:
                    raise Interrupted(k + 1)

    def _update(self, k: int) -> list[dict[str, float]]:
        """Make update `k` of all members that have come to it; returns their rows of metrics."""
        due = [index for index in self._active() if self.members[index].update == k]
        if not due:
            return []
        weights = [self._arrive(index, k) for index in due]

        def make() -> dict[int, Terms]:
            return self._make(due, weights, k)

        kinds = (self.members[index].kind(k, own) for index, own in zip(due, weights, strict=True))
        terms = self._recordings((*due, *kinds), make) if self._records else make()
        rows = []
        for index in due:
            if index in terms and index not in self.errors and not self.members[index].ended:
                with self._as_alone(index):
                    rows.append(self.members[index].record(k, terms[index]))
                    self.members[index].keep(stop=False)
        return rows

    def _make(self, due: Sequence[int], weights: Sequence[Weights], k: int) -> dict[int, Terms]:
        """Make update `k` of members at which all of them have arrived; returns the terms of those that make it."""
        learners = [self.members[index].learner for index in due]
        losses = [learner.loss for learner in learners]
        batches = [self._draw(index, own) for index, own in zip(due, weights, strict=True)]
        batch: TensorDictBase = TensorDict.stack(_completed(batches))  # pyright: ignore[reportAssignmentType]
        terms: dict[int, Terms] = {}
        for index, gradient in zip(due, self._losses("critic", losses, batch), strict=True):
            with self._ending(index):
                terms[index] = self.members[index].learner.lead_critics(gradient, k)
        step_together([one for index in terms for one in self.members[index].learner.critic_optimizers])
        if k % learners[0].actor_every == 0:
            # Rules of the actor take a batch with collocation points in another way than one without.
            within = ["collocation" in own.keys() for own in batches]
            kinds = {True: batch, False: batch.exclude("collocation")} if learners[0].train_actor else {}
            gradients = {kind: self._losses("actor", losses, kinds[kind]) for kind in kinds if kind in within}
            led = []
            for i, (index, learner) in enumerate(zip(due, learners, strict=True)):
                with self._ending(index):
                    if index in terms and gradients:
                        learner.lead_actor(gradients[within[i]][i], k)
                    if index in terms:
                        led.append(learner)
            step_together([one for learner in led if gradients for one in learner.actor_optimizers])
            for learner in led:
                learner.step_targets()
        made = {}
        for index, learner, own in zip(due, learners, batches, strict=True):
            if index in terms:
                found = {name: value for name, value in terms[index].items() if PARTS[name] in own.keys(True)}
                made[index] = found | {"loss_actor": learner.loss_actor}
        return made

    def _arrive(self, index: int, k: int) -> Weights:
        """Collect what is due before update `k` of a member, and prepare it; returns the loss weights of the member."""
        member = self.members[index]
        with self._as_alone(index):
            weights = member.arrive(k)
        # A term for which this member has no part of a batch has the weight 0, see `_completed`.
        parts = member.batches.parts(weights)
        td, hjb, boundary = (w if part else 0.0 for w, part in zip(weights, parts, strict=True))
        member.learner.prepare((td, hjb, boundary), member.curriculum.decay(k), k)
        return weights

    def _draw(self, index: int, weights: Weights) -> TensorDictBase:
        """The batch of a member with the random numbers of its losses."""
        member = self.members[index]
        with self._as_alone(index):
            return member.learner.loss.with_noise(member.draw(weights))

    def _active(self) -> list[int]:
        """The members whose training goes on."""
        return [i for i, member in enumerate(self.members) if not member.ended and i not in self.errors]

    @contextmanager
    def _ending(self, index: int) -> Iterator[None]:
        """End the training of a member alone if it diverges."""
        try:
            yield
        except DivergenceError as error:
            try:
                self.members[index].recover(error)
            except DivergenceError as last:
                self.errors[index] = last

    @contextmanager
    def _as_alone(self, index: int) -> Iterator[None]:
        """Draw the random numbers that the member would draw if it were trained alone.

        Where updates are recorded, the members share torch's default random generator. It gives the noise on actions,
        and all else comes from generators of the members.
        """
        if self._records:
            with self._ending(index):
                yield
            return
        checkpoint.restore_global_rngs(self._numbers[index])
        with self._ending(index):
            yield
        self._numbers[index] = checkpoint.global_rng_states()


@contextmanager
def _without_denormals() -> Iterator[None]:
    """Take numbers below 1e-38 as 0 in this thread; gradients may contain them where V is near 0 or 1.

    With them a product of matrices takes a processor many times as long. The updates of `reach1d` became twice as long
    by them in a population; those of runs alone, whose programs have other operations, did not.
    """
    before = torch.tensor(1e-39).mul(1.0).item() == 0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


def _share_programs(members: Sequence[Trainer]) -> None:
    """Let all members play the simulator and the policy of the first, so that they are compiled once."""
    collectors = [member.collector for member in members]
    playing = [one for one in collectors if isinstance(one, SyncCollector)]
    if len(playing) < len(collectors):
        return
    share_program([one.policy for one in playing])
    for member, collector in zip(members, playing, strict=True):
        first = playing[0].env.simulator
        if collector.env.simulator == first:
            collector.env.simulator = first
            if member.simulator.shared is not None:
                member.simulator.share(first)


def _completed(batches: Sequence[TensorDictBase]) -> list[TensorDictBase]:
    """The batches, where a part that only some members have is copied to the others, so that all can be stacked.

    Its term has the weight 0 for the others, so that their gradients stay as they are.
    """
    completed = [batch.copy() for batch in batches]
    for part in PARTS.values():
        owners = [batch for batch in completed if part in batch.keys(True)]
        for batch in completed:
            if owners and part not in batch.keys(True):
                batch[part] = owners[0][part]
    return completed
