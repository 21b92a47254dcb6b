"""The trainer: collect, sample, update, log, evaluate, checkpoint, in one loop that reads top to bottom."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage

from pirl_rl import checkpoint, recording
from pirl_rl.collectors import TransitionCollector
from pirl_rl.curriculum import Curriculum, Stage, StageSettings
from pirl_rl.errors import ArgumentError, DivergenceError, Interrupted
from pirl_rl.evaluation import Evaluator, Evidence, evaluate, metrics_of, statements_of
from pirl_rl.files import replacing
from pirl_rl.guard import Rollback
from pirl_rl.internals import generator_of
from pirl_rl.learner import Learner
from pirl_rl.loggers import MetricsLogger, NoLogger
from pirl_rl.products import fast_products
from pirl_rl.progress import Progress, announce, interruptible
from pirl_rl.recording import Recordings
from pirl_rl.run_directory import RunDirectory
from pirl_rl.sampling.batches import BatchSampler
from pirl_rl.sampling.boundary import BoundarySampler
from pirl_rl.sampling.collocation import Collocation
from pirl_rl.schedules import WEIGHTS, Schedule, Weights
from pirl_rl.simulator import Simulator


class Trainer:
    """Trains networks and leaves the evidence in a run directory.

    Attributes:
        solution: the networks as they stand, with their problem.
        evidence: what the final evaluators measured, by name; empty before the end of training.

    Args:
        learner: makes the updates.
        collector: fills the replay buffer.
        collocation, boundary: samplers of the physics.
        schedule: loss weights over the run.
        stages: what changes over the run; none is a run of one stage.
        updates: critic updates of the whole run.
        batch_size: transitions of an update.
        log_every: updates between rows of metrics.
        evaluate_every: updates between evaluations during training; 0 for none.
        checkpoint_every: updates between checkpoints; 0 for the last one only.
        checkpoint_seconds: seconds after which there is a checkpoint in any case, so that a kill costs no more; 0 for
            none.
        rollback: whether a run that collapses ends with the networks of its last good evaluation, see `Guard`.
        during, final: evaluators during and after training, by name.
        simulator: plays the paths of the evaluators; default a `Simulator` of the problem with its default steps.
        logger: takes the rows of metrics.
        folder: the run directory; None keeps everything in memory.
        config: the settings of the run, for loggers that show them.
        seed: of the collocation and boundary points.

    Raises:
        ArgumentError: a number out of range, an actor rule that does not fit the critics or the noise, or `rollback`
            without evaluations of success.
    """

    def __init__(
        self,
        learner: Learner,
        collector: TransitionCollector,
        collocation: Collocation,
        boundary: BoundarySampler,
        schedule: Schedule,
        stages: Sequence[Stage] = (),
        updates: int = 15_000,
        batch_size: int = 256,
        log_every: int = 100,
        evaluate_every: int = 1_500,
        checkpoint_every: int = 5_000,
        checkpoint_seconds: float = 60.0,
        rollback: bool = False,
        during: Mapping[str, Evaluator] | None = None,
        final: Mapping[str, Evaluator] | None = None,
        simulator: Simulator | None = None,
        logger: MetricsLogger | None = None,
        folder: Path | str | None = None,
        config: Mapping[str, Any] | None = None,
        seed: int = 0,
    ):
        for name, value, least in (
            ("updates", updates, 1),
            ("batch_size", batch_size, 1),
            ("log_every", log_every, 1),
            ("evaluate_every", evaluate_every, 0),
            ("checkpoint_every", checkpoint_every, 0),
        ):
            if not (isinstance(value, int) and value >= least):
                raise ArgumentError(f"trainer.{name}: expected an integer >= {least}, got {value!r}")
        if not checkpoint_seconds >= 0:
            raise ArgumentError(f"trainer.checkpoint_seconds: expected a number >= 0, got {checkpoint_seconds!r}")
        self.checkpoint_seconds = checkpoint_seconds
        self.learner, self.collector = learner, collector
        self.curriculum = Curriculum(schedule, updates, stages or (Stage(),))
        self._run_settings = StageSettings(
            initial_states=collector.initial_states,
            collocation=collocation,
            n_steps=collector.n_steps,
            actor_every=learner.actor_every,
            actor_rule=learner.loss.actor_rule,
            exploration_noise=collector.exploration_noise,
            learning_rate=learner.learning_rate,
        )
        for stage in self.curriculum.stages:
            settings = stage.over(self._run_settings)
            learner.loss.check_rule(settings.actor_rule, settings.exploration_noise)
        self.updates = updates
        self.log_every, self.evaluate_every, self.checkpoint_every = log_every, evaluate_every, checkpoint_every
        self.during, self.final = dict(during or {}), dict(final or {})
        self.simulator = simulator or Simulator(learner.loss.problem)
        self.evidence: dict[str, Evidence] = {}
        self.folder = None if folder is None else Path(folder)
        self.logger = logger if logger is not None and self.folder is not None else NoLogger()
        self.config = dict(config or {})
        self.solution = learner.loss.solution()
        self.batches = BatchSampler(
            collector.buffer,
            collocation,
            boundary,
            batch_size,
            self.curriculum.largest_weights(),
            self.solution.device,
            seed,
        )
        self.rollback: Rollback | None = None
        if rollback:
            self.rollback = Rollback.of(learner, self.during, self.simulator, evaluate_every)
        # A buffer that worker processes fill is in the memory of the CPU.
        device, storage = self.solution.device, collector.buffer.storage
        self.records = recording.records(device) and isinstance(storage, LazyTensorStorage) and storage.device == device
        self._recordings = Recordings("an update", self.generators)
        self._progress: float | Tensor = torch.zeros((), device=device) if self.records else 0.0
        self.update, self.saved, self.wall_seconds = 0, 0, 0.0
        self._started = self._saved_at = 0.0

    def train(self) -> dict[str, float]:
        """Train to the last update and evaluate; returns the summary.

        Raises:
            DivergenceError: a loss exploded; the last checkpoint is from before.
            Interrupted: on SIGINT, after a checkpoint.
        """
        with self.products():
            self.open()
            try:
                if not self.ended:
                    with interruptible() as interrupted:
                        self.begin()
                        announce("compiling the losses, and training" if self.learner.gradients.compile else "training")
                        self._loop(interrupted)
            except DivergenceError as error:
                self.recover(error)
            finally:
                self.close()
            return self.finish()

    def _loop(self, interrupted: Callable[[], bool]) -> None:
        with Progress(self.updates, self.update) as progress:
            for k in range(self.update, self.updates):
                progress.show(k + 1, self.record(k, self.advance(k)))
                stop = interrupted() and self.update < self.updates
                self.keep(stop)
                if stop:
                    raise Interrupted(self.update)

    # The methods from here to `finish` are the parts of `train`, which `Population` calls for each of its members.

    def products(self) -> AbstractContextManager[bool]:
        """Matrix products by the library that is faster for the critics and the batches, see `fast_products`."""
        if self.solution.device.type != "cpu":
            return nullcontext(False)
        layers = [*self.learner.loss.qvalue_network_params.parameters()]
        return fast_products(len(layers[0]), self.batches.size, max(layer.shape[-1] for layer in layers))

    @property
    def ended(self) -> bool:
        """Whether all updates are made, or a collapse has ended training before."""
        return self.update == self.updates or (self.rollback is not None and self.rollback.collapsed_at is not None)

    def open(self) -> None:
        """Open the log."""
        if self.folder is not None:
            self.logger.open(self.folder, self.config)
            self.logger.rewind(self.update)

    def begin(self) -> None:
        """Prepare the first update: enter its stage, judge the networks as they are, and play the warm-up."""
        if self.update == 0 or not self.curriculum.is_first(self.update):
            self._enter_stage()  # else its first update does, after a checkpoint at the end of the stage before
        if self.rollback is not None and self.rollback.good_at is None:
            self.rollback.judge(self.update)
        announce("playing the first transitions")
        self.collector.start()
        self._started, self._saved_at = time.perf_counter() - self.wall_seconds, time.perf_counter()

    def advance(self, k: int) -> dict[str, Tensor]:
        """Make update `k`, after what is due before it; returns the terms that `Learner.update` returns."""
        weights = self.arrive(k)
        self.learner.prepare(weights, self.curriculum.decay(k), k)

        def update() -> dict[str, Tensor]:
            return self.learner.make(self.draw(weights), k)

        return self._recordings(self.kind(k, weights), update) if self.records else update()

    def arrive(self, k: int) -> Weights:
        """Collect what is due before update `k`; returns its loss weights."""
        if self.curriculum.is_first(k):
            self._enter_stage()
        self.collector.step(k)
        self._progress = recording.renewed(self._progress, self.curriculum.progress(k))
        return self.curriculum.weights(k)

    def draw(self, weights: Weights) -> TensorDict:
        """The batch of the update at which training has arrived."""
        return self.batches.sample(weights, self._progress)

    def kind(self, k: int, weights: Weights) -> tuple[Hashable, ...]:
        """What decides which kernels update `k` launches, and on which memory."""
        acts, size = k % self.learner.actor_every == 0, len(self.collector.buffer)
        return self.curriculum.index(k), self.batches.parts(weights), acts, size

    @property
    def generators(self) -> list[torch.Generator]:
        """The random generators from which updates draw, beside torch's default one."""
        own = generator_of(self.collector.buffer)
        return [self.batches.rng, *([] if own is None else [own])]

    def record(self, k: int, terms: Mapping[str, Tensor]) -> dict[str, float]:
        """Count update `k`, log its row of metrics and judge it; returns the row, which may be empty.

        Raises:
            CollapseError: training has collapsed, see `Guard`.
        """
        self.update, self.wall_seconds = k + 1, time.perf_counter() - self._started
        row = self._row(k, terms)
        if row:
            self.learner.check(self.update)
            self.logger.log(row)
        if self.rollback is not None and ("success_rate" in row or self.update == self.updates):
            self.rollback.judge(self.update, row)
        return row

    def keep(self, stop: bool) -> None:
        """Write a checkpoint if one is due, or if training is about to `stop`."""
        due = bool(self.checkpoint_every) and self.update % self.checkpoint_every == 0
        late = 0 < self.checkpoint_seconds <= time.perf_counter() - self._saved_at
        if due or late or stop or self.update == self.updates:
            self.save(keep_weights=due and self.update < self.updates)

    def recover(self, error: DivergenceError) -> None:
        """End a training that has diverged with the networks of its last good evaluation.

        Raises:
            DivergenceError: there is no rollback; the message says which checkpoint there is.
        """
        if self.rollback is None or self.rollback.good_at is None:
            kept = f"the checkpoint of update {self.saved} is kept" if self.saved else "there is no checkpoint yet"
            raise DivergenceError(f"{error}; {kept}") from None
        self.rollback.restore(self.update, str(error))
        self.save()

    def close(self) -> None:
        """Stop playing, and close the log."""
        self.collector.close()
        self.logger.close()

    def _enter_stage(self) -> None:
        """Take over what the stage of the next update sets, and the run's own for the rest."""
        if self.curriculum.freezes(self.update):
            self.learner.settle_actor()
        settings = self._play(self.update)
        self.batches.collocation = settings.collocation
        self.learner.apply(settings)

    def _play(self, update: int) -> StageSettings:
        """Let the collector play as the stage of an update says; returns the settings of the stage."""
        settings = self.curriculum.stage(update).over(self._run_settings)
        self.collector.play(settings.initial_states, settings.n_steps, settings.exploration_noise)
        return settings

    def _row(self, k: int, terms: Mapping[str, Tensor]) -> dict[str, float]:
        """The metrics of an update, on those that log; empty on others."""
        evaluates = bool(self.evaluate_every) and (k == 0 or self.update % self.evaluate_every == 0)
        if not (k == 0 or evaluates or self.update % self.log_every == 0):
            return {}
        stage = {"stage": self.curriculum.index(k)} if len(self.curriculum.stages) > 1 else {}
        weights = dict(zip(WEIGHTS, self.curriculum.weights(k), strict=True))
        row = {"update": self.update, **stage, **weights, "learning_rate": self.learner.rate(self.curriculum.decay(k))}
        for name in ("td_loss", "hjb_loss", "boundary_loss", "loss_actor"):
            value = terms[name].item() if name in terms else math.nan
            row[name if name.startswith("loss") else f"train_{name}"] = value
        if evaluates:
            row |= metrics_of(evaluate(self.solution, self.simulator, self.during))
        return row

    def finish(self) -> dict[str, float]:
        """Evaluate, and write the summary; returns it."""
        if self.final:
            announce(f"measuring: {', '.join(self.final)}")
        self.evidence = evaluate(self.solution, self.simulator, self.final)
        summary: dict[str, float] = {
            "updates": self.update,
            "wall_seconds": self.wall_seconds,
            "updates_per_second": self.update / self.wall_seconds if self.update else 0.0,
            **({} if self.rollback is None else self.rollback.summary()),
            **metrics_of(self.evidence),
        }
        if self.folder is not None:
            with replacing(RunDirectory(self.folder).summary) as file:
                file.write(json.dumps(statements_of(self.evidence) | summary, indent=2) + "\n")
        return summary

    def save(self, keep_weights: bool = False) -> None:
        """Write `checkpoints/last.pt`, and the weights alone beside it if they are to be kept.

        Raises:
            DivergenceError: where the networks are spoilt; the checkpoint before stays.
        """
        self.learner.check(self.update)
        self._saved_at = time.perf_counter()
        if self.folder is None:
            return
        run = RunDirectory(self.folder)
        checkpoint.save(self.state_dict(), run.last)
        for path in (run.summary, run.evaluation):
            path.unlink(missing_ok=True)  # of a run that goes on: they are about earlier networks
        if keep_weights:
            weights = {"loss": self.learner.loss.state_dict(), "update": self.update}
            checkpoint.save(weights, run.weights(self.update))
        self.saved = self.update

    def state_dict(self) -> dict[str, Any]:
        """Everything that an exact continuation needs, as tensors and plain values."""
        return {
            "update": self.update,
            "wall_seconds": self.wall_seconds,
            "learner": self.learner.state_dict(),
            "collector": self.collector.state_dict(),
            "rollback": None if self.rollback is None else self.rollback.state_dict(),
            "rng": self.batches.rng.get_state(),
            **checkpoint.global_rng_states(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state; call it before `train`."""
        self.update, self.saved, self.wall_seconds = state["update"], state["update"], state["wall_seconds"]
        self.learner.load_state_dict(state["learner"])
        self._recordings.forget()
        # Initial states that were drawn ahead are those of the stage of the last update.
        self._play(max(self.update - 1, 0))
        self.collector.load_state_dict(state["collector"])
        if self.rollback is not None and state.get("rollback") is not None:
            self.rollback.load_state_dict(state["rollback"])
        checkpoint.restore_rng(self.batches.rng, state["rng"])
        checkpoint.restore_global_rngs(state)
