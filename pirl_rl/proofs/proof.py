"""Proved bounds of the probability of success: from below for a policy, and from above for all policies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar
from zipfile import BadZipFile

import numpy as np
import torch

from pirl_rl.errors import ProofError
from pirl_rl.files import replacing
from pirl_rl.problem import ReachAvoidProblem, with_indicator
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.spline import Spline

STATES = 20_000
"""The number of states by which a proved bound is described."""

LEVELS = (0.5, 0.8, 0.9)
"""The probabilities of which a proof says how large a share of the box of states has at least them."""

LISTED = 20
"""The largest number of boxes that resist which are listed for each condition."""

EVALUATION = 1e-9
"""A bound of the rounding errors in the value of a spline at a point."""

BEYOND = 1e-6
"""The share of the box's width by which points may lie beyond it, for states in single precision."""

COMPARED = 64
"""The number of states and controls at which the physics of a problem is compared with that of a file."""

SAME = 1e-9
"""The difference of the physics at these states that counts as rounding, relative to the largest value there."""


@dataclass(frozen=True, kw_only=True)
class Proof(ABC):
    """W - margin, a lower bound of a probability under continuous feedback.

    Attributes:
        problem: the problem, with the indicator as its payoff: the hard sets count.
        spline: W.
        margin: what is taken from W, so that no condition fails.
        resisted: the boxes on which a condition holds with this margin only, by the name of the condition.
        boxes: the number of boxes that were bounded.
        seconds: the time that fit and proof took, in s.
    """

    problem: ReachAvoidProblem
    spline: Spline
    margin: float
    resisted: dict[str, Boxes]
    boxes: int
    seconds: float

    METHOD: ClassVar[str] = "affine arithmetic and Taylor models on the HJB inequality, branch and bound"
    TRIVIAL: ClassVar[int]
    COMMAND: ClassVar[str] = "method=interval"

    @abstractmethod
    def bound(self, tau: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The bound (N,) of the probability of success at times to go (N,) in s and states (N, n) outside A and B.

        Raises:
            ProofError: a time to go or a state is not in the box of the bound.
        """

    @property
    def holds(self) -> bool:
        """Whether the bound says anything with T to go: at some state of many, W - margin is above 0."""
        return bool(self._sampled[1].max() > 0)

    @cached_property
    def _sampled(self) -> tuple[np.ndarray, np.ndarray]:
        """States (N, n) of the box outside A and B, and W - margin (N,) there at tau = T, not below 0."""
        x = self.problem.states.sample(STATES, torch.Generator().manual_seed(0), torch.float64)
        x = x[self.problem.interior(x)].numpy()
        return x, self._least(np.full(len(x), self.problem.horizon), x)

    def _least(self, tau: np.ndarray, x: np.ndarray) -> np.ndarray:
        """W - margin (N,), between 0 and 1."""
        points = np.column_stack([tau, x])
        low, high = (np.array([axis[end] for axis in self.spline.edges]) for end in (0, -1))
        reach = BEYOND * (high - low)
        beyond = ~((points >= low - reach) & (points <= high + reach)).all(-1)
        if beyond.any():
            raise ProofError(
                f"bound: expected (tau, x) between {low.tolist()} and {high.tolist()}, got {points[beyond][0].tolist()}"
            )
        return np.clip(self.spline(np.clip(points, low, high)) - self.margin - EVALUATION, 0.0, 1.0)

    def _described(self) -> dict[str, Any]:
        """What both kinds of bounds say of their proof, as plain values."""
        return {
            "problem": type(self.problem).__name__,
            "method": self.METHOD,
            "holds": self.holds,
            "boxes": self.boxes,
            "seconds": self.seconds,
            "margin": self.margin,
            "resisted": {name: boxes.centre[:LISTED].tolist() for name, boxes in self.resisted.items()},
        }

    def save(self, path: Path) -> None:
        """Write the proved bound to one file of numpy arrays, with what it is about."""
        self._save(path)

    def _save(self, path: Path, **about: Any) -> None:
        edges = {f"edges_{axis}": values for axis, values in enumerate(self.spline.edges)}
        numbers = np.array([self.margin, self.boxes, self.seconds])
        with replacing(path, binary=True) as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                coefficients=self.spline.coefficients.numpy(),
                numbers=numbers,
                physics=physics_of(self.problem),
                **edges,  # type: ignore[arg-type]
                **about,
            )

    @classmethod
    def _read(
        cls, path: str | Path, problem: ReachAvoidProblem, *about: str
    ) -> tuple[dict[str, Any], list[np.ndarray]]:
        """The fields of a proof, without the boxes that resisted; and further arrays of the file by their names.

        Raises:
            ProofError: the file is missing or not a proof of this kind, or it is about another problem.
        """
        try:
            with np.load(path) as file:
                arrays = {name: file[name] for name in file.files}
            subjects, physics = [arrays[name] for name in about], arrays["physics"]
            margin, boxes, seconds = arrays["numbers"].tolist()
            spline = Spline(
                [arrays[f"edges_{axis}"] for axis in range(arrays["coefficients"].ndim)], arrays["coefficients"]
            )
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise ProofError(f"{path}: expected a file of `certify method=interval`, got {error}") from None
        if not _is_about(physics, problem):
            raise ProofError(
                f"{path}: it proves something about a problem with other drift, noise, sets, controls or horizon than "
                f"{type(problem).__name__}; prove again with {cls.COMMAND}"
            )
        fields = {"problem": with_indicator(problem), "spline": spline, "margin": margin, "resisted": {}}
        return fields | {"boxes": int(boxes), "seconds": seconds}, subjects


@dataclass(frozen=True, kw_only=True)
class LowerBound(Proof):
    """A lower bound of the probability of success of one policy.

    Attributes:
        networks: the SHA-256 of the policy and V, for which the bound holds.
    """

    networks: str

    TRIVIAL = 0

    def bound(self, tau: np.ndarray, x: np.ndarray) -> np.ndarray:
        return self._least(tau, x)

    def to_dict(self) -> dict[str, Any]:
        """What is proved, as plain values: the bound at tau = T over the box of states, and the boxes that resist."""
        x, bound = self._sampled
        return {
            **self._described(),
            "bounded": "the probability of success of the policy under continuous feedback, from below",
            "networks": self.networks,
            "mean": float(bound.mean()),
            "best": float(bound.max()),
            "best_state": x[bound.argmax()].tolist(),
            **{f"share_at_least_{level:g}": float((bound >= level).mean()) for level in LEVELS},
        }

    def save(self, path: Path) -> None:
        self._save(path, networks=self.networks)

    @classmethod
    def load(cls, path: str | Path, problem: ReachAvoidProblem, networks: str) -> LowerBound:
        """Read a proved bound, without the boxes that resisted.

        Args:
            path: the file.
            problem: the problem that the bound is about.
            networks: the SHA-256 of the networks to which the bound is to apply.

        Raises:
            ProofError: the file is missing or not a proof, or it is about other networks or another problem.
        """
        fields, [found] = cls._read(path, problem, "networks")
        if str(found) != networks:
            raise ProofError(
                f"{path}: it proves something about networks with SHA-256 {str(found)[:12]}, and those of this run "
                f"have {networks[:12]}; prove again with {cls.COMMAND}"
            )
        return cls(networks=networks, **fields)


@dataclass(frozen=True, kw_only=True)
class UpperBound(Proof):
    """An upper bound of the probability of success of every policy: 1 - (W - margin), where W bounds that of failure.

    It does not depend on a policy, a training or networks, but on the problem alone.
    """

    TRIVIAL = 1
    COMMAND = "method=interval bounds=[upper]"

    def bound(self, tau: np.ndarray, x: np.ndarray) -> np.ndarray:
        return 1 - self._least(tau, x)

    def gap(self, lower: LowerBound) -> float:
        """The mean distance of both bounds at tau = T over the box of states: the policy loses no more to the best."""
        x, failure = self._sampled
        return float(1 - (failure + lower.bound(np.full(len(x), self.problem.horizon), x)).mean())

    def to_dict(self) -> dict[str, Any]:
        """What is proved, as plain values: the bound at tau = T over the box of states, and the boxes that resist."""
        x, failure = self._sampled
        return {
            **self._described(),
            "bounded": "the probability of success of every policy, from above",
            "mean": float(1 - failure.mean()),
            "lowest": float(1 - failure.max()),
            "lowest_state": x[failure.argmax()].tolist(),
            **{f"share_below_{level:g}": float((1 - failure < level).mean()) for level in LEVELS},
        }

    @classmethod
    def load(cls, path: str | Path, problem: ReachAvoidProblem) -> UpperBound:
        """Read a proved bound, without the boxes that resisted.

        Args:
            path: the file.
            problem: the problem to which the bound is to apply.

        Raises:
            ProofError: the file is missing or not an upper bound, or it is about another problem.
        """
        return cls(**cls._read(path, problem)[0])


def physics_of(problem: ReachAvoidProblem) -> np.ndarray:
    """Numbers (k,) by which problems differ: boxes, horizon and objective; drift, noise and levels at some states."""
    return np.concatenate(_physics(problem))


def _is_about(physics: np.ndarray, problem: ReachAvoidProblem) -> bool:
    """Whether numbers (k,) are `physics_of` a problem, up to rounding beside the largest value of each function."""
    parts = _physics(problem)
    size = np.concatenate([np.full(len(part), np.abs(part).max(initial=0.0)) for part in parts])
    own = np.concatenate(parts)
    return physics.shape == own.shape and bool((np.abs(physics - own) <= SAME * size).all())


def _physics(problem: ReachAvoidProblem) -> list[np.ndarray]:
    """The parts of `physics_of`."""
    rng = torch.Generator().manual_seed(0)
    x = problem.states.sample(COMPARED, rng, torch.float64)
    u = problem.controls.sample(COMPARED, rng, torch.float64)
    boxes = [
        torch.tensor(end, dtype=torch.float64)
        for box in (problem.states, problem.controls)
        for end in (box.low, box.high)
    ]
    scalars = [
        torch.tensor([value], dtype=torch.float64) for value in (problem.horizon, problem.objective == "invariance")
    ]
    values = [*boxes, *scalars, problem.drift(x, u), problem.diffusion(x, u)]
    if problem.objective == "reach-avoid":
        values.append(problem.target_constraints(x))
    if problem.has_avoid_set:
        values.append(problem.avoid_constraints(x))
    return [value.double().flatten().numpy() for value in values]
