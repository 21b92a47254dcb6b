"""A collector of one's own: it plays more often at the start of a run, when the policy changes fast."""

from typing import Any

from pirl_rl.collectors import SyncCollector
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.errors import ArgumentError
from pirl_rl.networks import Actor


class FrontLoaded(SyncCollector):
    """Plays a batch every `updates_per_batch` updates, and `factor` times as often in the first `early` updates.

    Args:
        env: the environment, which the package hands over.
        actor: the actor in training, which the package hands over too.
        updates_per_batch: updates between two batches after the first `early` updates.
        early: the number of updates that count as the start of the run.
        factor: batches are played this many times as often there; it divides `updates_per_batch`.
        settings: the other arguments of `SyncCollector`.

    Raises:
        ArgumentError: a factor that does not divide `updates_per_batch`.
    """

    def __init__(
        self,
        env: ReachAvoidEnv,
        actor: Actor,
        updates_per_batch: int = 80,
        early: int = 1_000,
        factor: int = 5,
        **settings: Any,
    ):
        super().__init__(env, actor, updates_per_batch=updates_per_batch, **settings)
        if factor < 1 or updates_per_batch % factor:
            raise ArgumentError(
                f"collector.factor: expected a divisor of updates_per_batch={updates_per_batch}, got {factor}"
            )
        self.later, self.early, self.factor = updates_per_batch, early, factor

    def step(self, update: int) -> None:
        """Called before each update; a batch is played where `updates_per_batch` divides the update."""
        self.updates_per_batch = self.later // self.factor if update < self.early else self.later
        super().step(update)
