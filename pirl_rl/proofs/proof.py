"""A proved lower bound of a policy's probability of success, for up to three states."""

from __future__ import annotations

import copy
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from torch import Tensor

from pirl_rl.arguments import check_integer
from pirl_rl.errors import ProofError
from pirl_rl.files import replacing
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.progress import announce
from pirl_rl.proofs.affine import Affine
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.conditions import Conditions
from pirl_rl.proofs.mesh import Mesh, mesh_of
from pirl_rl.proofs.search import Outcome, prove
from pirl_rl.proofs.spline import DEGREE, Spline
from pirl_rl.proofs.subsolution import Equation
from pirl_rl.solution import Solution

MOST_STATES = 3
"""The largest number of states for which proofs are tried."""

MARGIN = 0.005
"""The number by which W is lowered, so that its conditions hold on the parabolic boundary in spite of rounding."""

LEAST = 0.002
"""The value of L^pi W, in 1/s, at which a fit aims."""

RAISE = 1.2
"""The factor by which the source is raised beyond a violation."""


STATES, LEVELS = 20_000, (0.5, 0.8, 0.9)
"""The number of states, and the probabilities, by which a proved bound is described."""

LISTED = 20
"""The largest number of boxes that resist which are listed for each condition."""


@dataclass(frozen=True)
class Settings:
    """The effort of a proof.

    Attributes:
        cells: the number of cells along each state.
        steps: the number of cells along tau.
        rounds: the number of times that W is fitted again.
        halvings: the number of times that a box may be halved.

    Raises:
        ArgumentError: a number is too small.
    """

    cells: int = 80
    steps: int = 80
    rounds: int = 20
    halvings: int = 8

    def __post_init__(self):
        for name, least in (("cells", 8), ("steps", 8), ("rounds", 1), ("halvings", 0)):
            check_integer(name, getattr(self, name), least)


@dataclass(frozen=True)
class Proof:
    """W - margin, a lower bound of the probability of success of a policy under continuous feedback.

    Attributes:
        spline: W.
        margin: what is taken from W.
        unproved: the boxes that resist, by the name of the condition; without any, the bound is proved.
        boxes: the number of boxes that were bounded in the last round.
        networks: the SHA-256 of the policy and V, for which the bound holds.
        seconds: the time that fit and proof took, in s.
    """

    spline: Spline
    margin: float
    unproved: dict[str, Boxes]
    boxes: int
    networks: str
    seconds: float

    @property
    def holds(self) -> bool:
        return not self.unproved

    def bound(self, tau: np.ndarray, x: np.ndarray) -> np.ndarray:
        """The lower bound (N,) at times to go (N,) in s and states (N, n) outside A and B.

        Raises:
            ProofError: the conditions were not proved.
        """
        if not self.holds:
            left = ", ".join(f"{name} on {len(boxes):,} boxes" for name, boxes in self.unproved.items())
            raise ProofError(f"no bound: conditions are not proved, {left}")
        return _bound(self.spline, self.margin, tau, x)

    def to_dict(self, problem: ReachAvoidProblem) -> dict[str, Any]:
        """What is proved, as plain values: the bound at tau = T over the box of states, and the boxes that resist."""
        result = {
            "problem": type(problem).__name__,
            "bounded": "the probability of success of the policy under continuous feedback, from below",
            "method": "affine arithmetic on the HJB inequality, branch and bound",
            "holds": self.holds,
            "networks": self.networks,
            "boxes": self.boxes,
            "seconds": self.seconds,
            "unproved": {name: boxes.centre[:LISTED].tolist() for name, boxes in self.unproved.items()},
        }
        if not self.holds:
            return result
        x = problem.states.sample(STATES, torch.Generator().manual_seed(0), torch.float64)
        x = x[problem.interior(x)].numpy()
        bound = self.bound(np.full(len(x), problem.horizon), x)
        shares = {f"share_at_least_{level:g}": float((bound >= level).mean()) for level in LEVELS}
        best = {"best": float(bound.max()), "best_state": x[bound.argmax()].tolist()}
        return result | {"mean": float(bound.mean())} | best | shares

    def save(self, path: Path) -> None:
        """Write the proved bound to one file of numpy arrays."""
        edges = {f"edges_{axis}": values for axis, values in enumerate(self.spline.edges)}
        with replacing(path, binary=True) as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                coefficients=self.spline.coefficients.numpy(),
                margin=self.margin,
                networks=self.networks,
                **edges,  # type: ignore[arg-type]
            )


def prove_success(solution: Solution, networks: str, settings: Settings | None = None) -> Proof:
    """Fit W to the policy of a solution, and prove it a lower bound of its probability of success.

    Args:
        solution: the problem and the policy; the networks are taken to be exact functions of real numbers.
        networks: the SHA-256 of the networks.
        settings: the effort.

    Raises:
        ProofError: there are no networks, too many states or periodic ones, or a function has no enclosure.
    """
    problem, settings = solution.problem, settings or Settings()
    if not hasattr(solution, "actor"):
        raise ProofError("proof: expected a policy that is a network, got that of a grid")
    if problem.states.dim > MOST_STATES:
        raise ProofError(f"proof: expected at most {MOST_STATES} states, got {problem.states.dim}")
    if problem.states.periodic:
        raise ProofError("proof: expected no periodic coordinates")
    started = time.perf_counter()
    policy = _feedback(solution)
    mesh = mesh_of(problem, settings.cells, settings.steps)
    equation = Equation(problem, policy, mesh)
    cells = Boxes.cells(mesh.edges)
    points = cells
    for axis in range(len(mesh.edges)):
        points = points.halves(torch.full((len(points),), axis))
    source, inside = np.full((len(mesh.taus), len(equation.x)), LEAST), Outcome(cells, 0)
    conditions = Conditions(problem, policy, equation.solve(source), MARGIN)
    for number in range(1, settings.rounds + 1):
        announce(f"fitting a bound, round {number}")
        missing = LEAST / 2 - conditions.residual(points)[0]
        if not bool((missing > 0).any()):
            break
        source = source + RAISE * _at_nodes(points, missing + LEAST / 2, mesh)
        conditions = Conditions(problem, policy, equation.solve(source), MARGIN)
    for number in range(1, settings.rounds + 1):
        announce(f"proving the bound, round {number}")
        inside = prove(conditions.interior, cells, settings.halvings)
        if inside.proved or number == settings.rounds:
            break
        source = source + RAISE * _at_nodes(inside.left, LEAST - conditions.residual(inside.left)[1], mesh)
        conditions = Conditions(problem, policy, equation.solve(source), MARGIN)
    outcomes = {"interior": inside} | _boundary(conditions, mesh, settings.halvings)
    return Proof(
        spline=conditions.spline,
        margin=MARGIN,
        unproved={name: outcome.left for name, outcome in outcomes.items() if not outcome.proved},
        boxes=sum(outcome.bounded for outcome in outcomes.values()),
        networks=networks,
        seconds=time.perf_counter() - started,
    )


def load_bound(path: Path, networks: str) -> Callable[[np.ndarray, np.ndarray], np.ndarray] | None:
    """The bound in a file that `Proof.save` wrote, a function like `Proof.bound`.

    Args:
        path: the file.
        networks: the SHA-256 of the policy and V.

    Returns:
        The function, or None if it was proved for other networks.

    Raises:
        ProofError: the file is broken.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["networks"]) != networks:
                return None
            axes = sum(name.startswith("edges_") for name in file.files)
            spline = Spline([file[f"edges_{axis}"] for axis in range(axes)], file["coefficients"])
            return partial(_bound, spline, float(file["margin"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ProofError(f"{path}: expected a proved bound, got {error}") from error


def _bound(spline: Spline, margin: float, tau: np.ndarray, x: np.ndarray) -> np.ndarray:
    """W - margin (N,), and 0 where it is negative."""
    return np.maximum(spline(np.column_stack([tau, x])) - margin, 0.0)


def _feedback(solution: Solution) -> Callable[[Any, Any], Any]:
    """The policy in double precision, of tensors or of affine forms tau (N,) and x (N, n)."""
    actor, controls = copy.deepcopy(solution.actor).cpu().double(), solution.problem.controls

    @torch.no_grad()
    def policy(tau: Tensor | Affine, x: Tensor | Affine):
        return controls.denormalize(actor(tau.unsqueeze(-1), x))

    return policy


def _at_nodes(boxes: Boxes, missing: Tensor, mesh: Mesh) -> np.ndarray:
    """The most that is missing in a box (N,) around each level of tau and each node, or 0: (levels of tau, nodes)."""
    found = np.zeros([len(axis) - 1 for axis in mesh.edges])
    np.maximum.at(found, tuple(boxes.cell.T.numpy()), missing.clamp(min=0).numpy())
    n = found.ndim - 1
    # A node has a cell on each side; the splines of DEGREE 3 next to it reach one cell further.
    padded = np.pad(found, [(1, 1), *[(1, DEGREE - 1)] * n], mode="edge")
    around = maximum_filter(padded, size=(1, *[DEGREE] * n))
    return np.maximum(around[:-1], around[1:]).reshape(len(mesh.taus), -1)


def _boundary(conditions: Conditions, mesh: Mesh, halvings: int) -> dict[str, Outcome]:
    """The conditions at tau = 0, on the sides of the mesh, and on the faces of A and B."""
    cells, problem, last = Boxes.cells(mesh.edges), conditions.problem, [len(axis) - 2 for axis in mesh.edges]
    found = {"tau = 0": prove(conditions.start, cells.at_end(0, 0, -1), halvings)}
    for axis in range(problem.states.dim):
        for outward, cell in ((-1, 0), (1, last[1 + axis])):

            def side(boxes: Boxes, axis: int = axis, outward: int = outward) -> tuple[Tensor, Tensor]:
                return conditions.side(boxes, axis, outward)

            name = f"the {'lower' if outward < 0 else 'upper'} side of coordinate {axis + 1}"
            found[name] = prove(side, cells.at_end(1 + axis, cell, outward), halvings)
    for name, constraints, most in _sets(problem):
        for number in range(constraints(torch.zeros(1, problem.states.dim, dtype=torch.float64)).shape[-1]):

            def face(boxes: Boxes, constraints=constraints, number: int = number, most: float = most):
                return conditions.face(boxes, constraints, number, most)

            found[f"face {number + 1} of {name}"] = prove(face, cells, halvings)
    return found


def _sets(problem: ReachAvoidProblem) -> list[tuple[str, Callable, float]]:
    """The sets at which paths end, with their constraints and their payoff."""
    sets = [("A", problem.reached_constraints, 1.0)] if problem.objective == "reach-avoid" else []
    return sets + ([("B", problem.avoid_constraints, 0.0)] if problem.has_avoid_set else [])
