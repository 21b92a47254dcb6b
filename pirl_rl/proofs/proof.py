"""A proved lower bound of a policy's probability of success."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch

from pirl_rl.errors import ProofError
from pirl_rl.files import replacing
from pirl_rl.problem import ReachAvoidProblem
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


@dataclass(frozen=True)
class Proof:
    """W - margin, a lower bound of the probability of success of a policy under continuous feedback.

    Attributes:
        spline: W.
        margin: what is taken from W, so that no condition fails.
        resisted: the boxes on which a condition holds with this margin only, by the name of the condition.
        boxes: the number of boxes that were bounded.
        networks: the SHA-256 of the policy and V, for which the bound holds.
        seconds: the time that fit and proof took, in s.
    """

    spline: Spline
    margin: float
    resisted: dict[str, Boxes]
    boxes: int
    networks: str
    seconds: float

    @property
    def holds(self) -> bool:
        """Whether the bound is above 0 somewhere, as far as the spline's coefficients tell."""
        return bool(self.spline.coefficients.max() > self.margin + EVALUATION)

    def bound(self, tau: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The lower bound (N,) at times to go (N,) in s and states (N, n) outside A and B.

        Raises:
            ProofError: a time to go or a state is not in the box of the bound.
        """
        points = np.column_stack([tau, x])
        low, high = (np.array([axis[end] for axis in self.spline.edges]) for end in (0, -1))
        reach = BEYOND * (high - low)
        beyond = ~((points >= low - reach) & (points <= high + reach)).all(-1)
        if beyond.any():
            raise ProofError(
                f"bound: expected (tau, x) between {low.tolist()} and {high.tolist()}, got {points[beyond][0].tolist()}"
            )
        return np.clip(self.spline(np.clip(points, low, high)) - self.margin - EVALUATION, 0.0, 1.0)

    def to_dict(self, problem: ReachAvoidProblem) -> dict[str, Any]:
        """What is proved, as plain values: the bound at tau = T over the box of states, and the boxes that resist."""
        x = problem.states.sample(STATES, torch.Generator().manual_seed(0), torch.float64)
        x = x[problem.interior(x)].numpy()
        bound = self.bound(np.full(len(x), problem.horizon), x)
        return {
            "problem": type(problem).__name__,
            "bounded": "the probability of success of the policy under continuous feedback, from below",
            "method": "affine arithmetic and Taylor models on the HJB inequality, branch and bound",
            "holds": self.holds,
            "networks": self.networks,
            "boxes": self.boxes,
            "seconds": self.seconds,
            "margin": self.margin,
            "resisted": {name: boxes.centre[:LISTED].tolist() for name, boxes in self.resisted.items()},
            "mean": float(bound.mean()),
            "best": float(bound.max()),
            "best_state": x[bound.argmax()].tolist(),
            **{f"share_at_least_{level:g}": float((bound >= level).mean()) for level in LEVELS},
        }

    def save(self, path: Path) -> None:
        """Write the proved bound to one file of numpy arrays."""
        edges = {f"edges_{axis}": values for axis, values in enumerate(self.spline.edges)}
        with replacing(path, binary=True) as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                coefficients=self.spline.coefficients.numpy(),
                numbers=np.array([self.margin, self.boxes, self.seconds]),
                networks=self.networks,
                **edges,  # type: ignore[arg-type]
            )

    @classmethod
    def load(cls, path: str | Path, networks: str) -> Proof:
        """Read a proved bound, without the boxes that resisted.

        Args:
            path: the file.
            networks: the SHA-256 of the networks to which the bound is to apply.

        Raises:
            ProofError: the file is missing or not a proof, or it is about other networks.
        """
        try:
            with np.load(path) as file:
                arrays = {name: file[name] for name in file.files}
            proved, (margin, boxes, seconds) = str(arrays["networks"]), arrays["numbers"].tolist()
            edges = [arrays[f"edges_{axis}"] for axis in range(arrays["coefficients"].ndim)]
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise ProofError(f"{path}: expected a file of `certify method=interval`, got {error}") from None
        if proved != networks:
            raise ProofError(
                f"{path}: it proves something about networks with SHA-256 {proved[:12]}, and those of this run have "
                f"{networks[:12]}; prove again with method=interval"
            )
        return cls(Spline(edges, arrays["coefficients"]), margin, {}, int(boxes), networks, seconds)
