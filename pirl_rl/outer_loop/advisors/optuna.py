"""An advisor that searches loss weights, schedule and collocation by Bayesian or random search with Optuna."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from pirl_rl.errors import ArgumentError
from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.advisors.continuation import rounded, sigmoid, starts
from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.plan import Candidate, Plan

try:
    import optuna
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("advisor=optuna needs Optuna: pip install 'pirl_rl[tune]'", name="optuna") from error

from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.samplers import BaseSampler, RandomSampler, TPESampler
from optuna.trial import FrozenTrial, create_trial


class Optuna:
    """Minimises calibration_mae. The study is rebuilt from the history in each round, so that no other state is kept.

    Candidates start from the best checkpoint with the weights in force there, and keep its TD weight. The search is
    over the logarithms of the final HJB and boundary weights, the center and the sharpness of the schedule in units of
    the candidate's length and, if the collocation has them, jitter and replay share. A candidate that collapsed, failed
    or lost reward counts with twice the largest error of the sound results.

    Args:
        sampler: "tpe", a tree-structured Parzen estimator, or "random".
        seed: seed of the sampler, >= 0; every round has its own stream.
        startup: number of finished candidates before TPE replaces random search.
        weights: smallest and largest final weight, 0 < smallest < largest <= 1000.
        jitter: largest jitter, 0 < jitter <= 1.

    Raises:
        ArgumentError: if an argument is out of its range.
    """

    def __init__(
        self,
        sampler: Literal["tpe", "random"] = "tpe",
        seed: int = 0,
        startup: int = 4,
        weights: Sequence[float] = (1e-4, 10.0),
        jitter: float = 0.1,
    ):
        if sampler not in ("tpe", "random"):
            raise ArgumentError(f"sampler: expected 'tpe' or 'random', got {sampler!r}")
        if seed < 0 or startup < 1:
            raise ArgumentError(f"seed, startup: expected seed >= 0 and startup >= 1, got {seed} and {startup}")
        if len(weights) != 2 or not 0 < weights[0] < weights[1] <= 1e3:
            raise ArgumentError(f"weights: expected [least, largest], 0 < least < largest <= 1000, got {list(weights)}")
        if not 0 < jitter <= 1:
            raise ArgumentError(f"jitter: expected 0 < jitter <= 1, got {jitter}")
        self.sampler, self.seed, self.startup = sampler, seed, startup
        low, high = (math.log10(weight) for weight in weights)
        self.space = {
            "hjb": FloatDistribution(low, high),
            "boundary": FloatDistribution(low, high),
            "center": FloatDistribution(0.3, 0.7),
            # With a slope of at least 10 the sigmoid starts near the initial weights and ends near the final ones.
            "slope": FloatDistribution(10.0, 100.0, log=True),
            "jitter": FloatDistribution(0.0, jitter),
            "replay_share": FloatDistribution(0.5, 1.0),
        }

    def propose(self, request: Request) -> str:
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(sampler=self._sampler(request.number))
        study.add_trials(self._finished(request.history, request.updates))
        chosen = []
        for number, start in enumerate(starts(request.history, request.candidates), 1):
            values = study.ask(self._space(start)).params
            chosen.append(_candidate(values, start, f"trial-{number}", request.updates))
        note = f"{self.sampler} sampler, seed {self.seed}, {len(study.trials) - len(chosen)} trials known"
        return Plan(round_note=note, candidates=chosen).model_dump_json(indent=1, exclude_none=True)

    def _sampler(self, number: int) -> BaseSampler:
        seed = int(np.random.SeedSequence([self.seed, number]).generate_state(1)[0])
        return RandomSampler(seed) if self.sampler == "random" else TPESampler(seed=seed, n_startup_trials=self.startup)

    def _space(self, start: Result) -> dict[str, BaseDistribution]:
        absent = {
            "jitter": start.collocation_jitter is None,
            "replay_share": start.collocation_replay_share is None,
        }
        return {name: values for name, values in self.space.items() if not absent.get(name, False)}

    def _finished(self, history: History, updates: int) -> list[FrozenTrial]:
        """The finished candidates, of any advisor, that lie in the search space, as trials."""
        sound = [history.baseline, *(result for result in history.results if history.keeps(result))]
        penalty = 2 * max(result.metrics["calibration_mae"] for result in sound)
        trials = []
        for result in history.results:
            values = {} if result.candidate is None else _values(result.candidate, result, updates)
            within = all(self.space[name].low <= value <= self.space[name].high for name, value in values.items())
            if values and within:
                value = result.metrics["calibration_mae"] if history.keeps(result) else penalty
                distributions: dict[str, BaseDistribution] = {name: self.space[name] for name in values}
                trials.append(create_trial(params=values, distributions=distributions, value=value))
        return trials


def _candidate(values: Mapping[str, float], start: Result, name: str, updates: int) -> Candidate:
    return Candidate(
        name=name,
        start_checkpoint=str(start.checkpoint),
        schedule_initial=start.weights,
        schedule_final=(start.weights[0], rounded(10 ** values["hjb"]), rounded(10 ** values["boundary"])),
        **sigmoid(updates, values["center"], values["slope"]),
        collocation_jitter=rounded(values["jitter"]) if "jitter" in values else None,
        collocation_replay_share=rounded(values["replay_share"]) if "replay_share" in values else None,
    )


def _values(candidate: Candidate, result: Result, updates: int) -> dict[str, float]:
    """The point of a finished candidate in the search space.

    A setting that the plan left out kept its value, which the result holds.
    """
    _, hjb, boundary = candidate.schedule_final
    values = {
        "hjb": math.log10(hjb) if hjb > 0 else -math.inf,
        "boundary": math.log10(boundary) if boundary > 0 else -math.inf,
        "center": candidate.schedule_center / updates,
        "slope": candidate.schedule_sharpness * updates,
        "jitter": candidate.collocation_jitter,
        "replay_share": candidate.collocation_replay_share,
    }
    if candidate.collocation_jitter is None:
        values["jitter"] = result.collocation_jitter
    if candidate.collocation_replay_share is None:
        values["replay_share"] = result.collocation_replay_share
    return {name: value for name, value in values.items() if value is not None}
