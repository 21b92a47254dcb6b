"""The proof of a bound: fit W, bound its conditions on boxes, and take from W what they lack."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pirl_rl.arguments import check_integer
from pirl_rl.errors import ProofError
from pirl_rl.grid import GridSolver
from pirl_rl.problem import ReachAvoidProblem, with_indicator
from pirl_rl.progress import announce
from pirl_rl.proofs.affine import Affine
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.conditions import Conditions, Feedback
from pirl_rl.proofs.ends import Absorbing, Ends
from pirl_rl.proofs.fit import Fit
from pirl_rl.proofs.mesh import mesh_of
from pirl_rl.proofs.points import States
from pirl_rl.proofs.proof import LowerBound, UpperBound
from pirl_rl.proofs.rates import LeastRates, Policy, PolicyRates, RatesAt
from pirl_rl.proofs.search import Check, Outcome, prove
from pirl_rl.proofs.subsolution import Equation
from pirl_rl.solution import Solution

MOST_STATES = 3
"""The largest number of states for which proofs are tried."""

MARGIN = 0.01
"""The number that is taken from W at least. No condition of the interior is asked where W is not above it."""

CELLS = {1: 64, 2: 64, 3: 16}
"""The number of cells along each state by the number of states, so that proofs take minutes and less than 8 GB."""

STEPS = {1: 60, 2: 60, 3: 16}
"""The number of cells along tau by the number of states."""

BOXES = 65_536
"""Boxes that resist are halved up to this number of them, or that of the cells of the mesh where it is larger."""

Condition = tuple[str, Check, Boxes]
"""The name of a condition, what bounds it, and the boxes on which it is asked."""


@dataclass(frozen=True)
class Settings:
    """The effort of a proof.

    Attributes:
        cells: the number of cells along each state; `CELLS` by default.
        steps: the number of cells along tau; `STEPS` by default.
        rounds: the largest number of times that W is fitted to points, and then to boxes.
        halvings: the number of times that a box may be halved.

    Raises:
        ArgumentError: a number is too small.
    """

    cells: int | None = None
    steps: int | None = None
    rounds: int = 40
    halvings: int = 10

    def __post_init__(self):
        for name, least in (("cells", 8), ("steps", 8), ("rounds", 1), ("halvings", 0)):
            if getattr(self, name) is not None:
                check_integer(name, getattr(self, name), least)


@dataclass(frozen=True)
class Claim:
    """What a proof is about.

    Attributes:
        ends: the problem, and what W may be where paths end.
        policy: the policy under which W is fitted.
        rates_at: the controls for which the fit asks L^u W >= 0.
        feedback: the controls for which this is proved.
        controls: the ends (2,) of the ranges of controls that are coordinates of the boxes.
    """

    ends: Ends
    policy: Policy
    rates_at: RatesAt
    feedback: Feedback
    controls: list[np.ndarray]


def prove_success(solution: Solution, networks: str, settings: Settings | None = None) -> LowerBound:
    """Prove a lower bound of the probability of success of a solution's policy.

    Args:
        solution: the problem and the policy; the networks are taken to be exact functions of real numbers.
        networks: the SHA-256 of the networks.
        settings: the effort.

    Raises:
        ProofError: there are no networks, an actor that chooses among numbers, too many states or periodic ones, or a
            function has no enclosure.
    """
    if not hasattr(solution, "actor"):
        raise ProofError("proof: expected a policy that is a network, got that of a grid")
    if choice := getattr(solution.actor, "choice", None):
        raise ProofError(
            "proof: expected a continuous policy, as with actor.choices=null, got one that chooses among "
            f"{choice.choices} numbers"
        )
    problem, policy = _provable(solution.problem), _policy(solution)

    def feedback(z: Any) -> Any:
        return policy(z[:, 0], z[:, 1:])

    def rates_at(points: States) -> PolicyRates:
        return PolicyRates(points, policy)

    claim = Claim(Ends(problem, True), policy, rates_at, feedback, [])
    return LowerBound(networks=networks, **_prove(claim, settings))


def prove_limit(problem: ReachAvoidProblem, settings: Settings | None = None) -> UpperBound:
    """Prove an upper bound of the probability of success of every policy, which is one of V.

    Args:
        problem: the physics.
        settings: the effort.

    Raises:
        ProofError: there are too many states or periodic ones, or a function has no enclosure.
    """
    problem = _provable(problem)
    announce("solving on a grid")
    # W is fitted to a policy that is nearly the best. The proof does not depend on it. The policy of drift and noise in
    # turns does not suit the fit: on the pendulum W cannot be raised to where it violates nothing.
    policy = GridSolver(problem, estimate=False, turns=False).solve().policy

    def feedback(z: Affine) -> Affine:
        return z[:, 1 + problem.states.dim :]

    controls = [np.array(ends) for ends in zip(problem.controls.low, problem.controls.high, strict=True)]
    return UpperBound(**_prove(Claim(Ends(problem, False), policy, LeastRates, feedback, controls), settings))


def _provable(problem: ReachAvoidProblem) -> ReachAvoidProblem:
    """The problem with its hard sets, if it has few enough states and none is periodic."""
    if problem.states.dim > MOST_STATES:
        raise ProofError(f"proof: expected at most {MOST_STATES} states, got {problem.states.dim}")
    if problem.states.periodic:
        raise ProofError("proof: expected no periodic coordinates")
    return with_indicator(problem)


def _prove(claim: Claim, settings: Settings | None) -> dict[str, Any]:
    """The fields of a proof."""
    settings, started = settings or Settings(), time.perf_counter()
    announce("fitting a bound")
    dim = claim.ends.problem.states.dim
    mesh = mesh_of(claim.ends, settings.cells or CELLS[dim], settings.steps or STEPS[dim])
    cells = Boxes.cells([*mesh.edges, *claim.controls])
    most = max(len(cells), BOXES)
    fit = Fit(Equation(claim.ends, claim.policy, mesh), claim.rates_at, MARGIN)
    fit.at_points(settings.rounds)

    def conditions() -> Conditions:
        return Conditions(claim.ends, claim.feedback, fit.spline, MARGIN)

    def search(check: Check, boxes: Boxes) -> Outcome:
        return prove(check, boxes, MARGIN, settings.halvings, most)

    outcomes = {"interior": _fit_on_boxes(fit, conditions, cells, settings.rounds, search)}
    for name, check, boxes in _boundary(conditions(), cells):
        outcomes[name] = search(check, boxes)
    return {
        "problem": claim.ends.problem,
        "spline": fit.spline,
        # W is not above its largest coefficient.
        "margin": min(max(outcome.margin for outcome in outcomes.values()), fit.spline.coefficients.max().item()),
        "resisted": {name: outcome.left for name, outcome in outcomes.items() if not outcome.proved},
        "boxes": sum(outcome.bounded for outcome in outcomes.values()),
        "seconds": time.perf_counter() - started,
    }


def _fit_on_boxes(
    fit: Fit,
    conditions: Callable[[], Conditions],
    everywhere: Boxes,
    rounds: int,
    search: Callable[[Check, Boxes], Outcome],
) -> Outcome:
    """Raise the source where L^u W >= 0 is not proved, until it is; the boxes that are left are those of all cells."""
    cells = everywhere
    for number in range(1, rounds + 1):
        announce(f"proving the bound, round {number}")
        present = conditions()
        outcome = search(present.interior, cells)
        if outcome.proved and cells is everywhere:
            return outcome
        if outcome.proved:
            cells = everywhere
            continue
        if not fit.on_boxes(outcome.left, present.residual(outcome.left)):
            break
        # The source changes W little elsewhere. All cells are proved again in the end.
        cells = everywhere.around(outcome.left)
    return search(conditions().interior, everywhere)


def _policy(solution: Solution) -> Policy:
    """The policy in double precision, of tensors or of affine forms tau (N,) and x (N, n)."""
    actor, controls = copy.deepcopy(solution.actor).cpu().double(), solution.problem.controls

    @torch.no_grad()
    def policy(tau: Any, x: Any) -> Any:
        return controls.denormalize(actor(tau.unsqueeze(-1), x))

    return policy


def _boundary(conditions: Conditions, cells: Boxes) -> list[Condition]:
    """The conditions at tau = 0, on the sides of the mesh, and on the faces of A and B."""
    found: list[Condition] = [("tau = 0", conditions.start, cells.at_end(0, 0, -1))]
    problem = conditions.ends.problem
    for axis in range(problem.states.dim):
        for outward, cell in ((-1, 0), (1, len(cells.edges[1 + axis]) - 2)):

            def side(boxes: Boxes, axis: int = axis, outward: int = outward) -> tuple[Tensor, Tensor]:
                return conditions.side(boxes, axis, outward)

            name = f"the {'lower' if outward < 0 else 'upper'} side of coordinate {axis + 1}"
            found.append((name, side, cells.at_end(1 + axis, cell, outward)))
    for absorbing in conditions.ends.sets():
        for number in range(absorbing.levels(torch.zeros(1, problem.states.dim, dtype=torch.float64)).shape[-1]):

            def face(boxes: Boxes, absorbing: Absorbing = absorbing, number: int = number) -> tuple[Tensor, Tensor]:
                return conditions.face(boxes, absorbing, number)

            found.append((f"face {number + 1} of {absorbing.name}", face, cells))
    return found
