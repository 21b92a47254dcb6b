"""The proof of a lower bound: fit W, bound its conditions on boxes, and take from W what they lack."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pirl_rl.arguments import check_integer
from pirl_rl.errors import ProofError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.progress import announce
from pirl_rl.proofs.affine import Affine
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.conditions import Conditions
from pirl_rl.proofs.fit import Fit
from pirl_rl.proofs.mesh import Mesh, mesh_of
from pirl_rl.proofs.proof import Proof
from pirl_rl.proofs.search import Check, Outcome, prove
from pirl_rl.proofs.subsolution import Equation
from pirl_rl.solution import Solution

MOST_STATES = 3
"""The largest number of states for which proofs are tried."""

MARGIN = 0.01
"""The number that is taken from W at least. No condition of the interior is asked where W is not above it."""

Condition = tuple[str, Check, Boxes]
"""The name of a condition, what bounds it, and the boxes on which it is asked."""


@dataclass(frozen=True)
class Settings:
    """The effort of a proof.

    Attributes:
        cells: the number of cells along each state.
        steps: the number of cells along tau.
        rounds: the largest number of times that W is fitted to points, and then to boxes.
        halvings: the number of times that a box may be halved.

    Raises:
        ArgumentError: a number is too small.
    """

    cells: int = 64
    steps: int = 60
    rounds: int = 40
    halvings: int = 10

    def __post_init__(self):
        for name, least in (("cells", 8), ("steps", 8), ("rounds", 1), ("halvings", 0)):
            check_integer(name, getattr(self, name), least)


def prove_success(solution: Solution, networks: str, settings: Settings | None = None) -> Proof:
    """Fit W to the policy of a solution, and prove W - margin a lower bound of its probability of success.

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
    started, policy = time.perf_counter(), _feedback(solution)
    announce("fitting a bound")
    mesh = mesh_of(problem, settings.cells, settings.steps)
    fit = Fit(Equation(problem, policy, mesh), policy, MARGIN)
    fit.at_points(settings.rounds)
    outcomes = {"interior": _fit_on_boxes(fit, problem, policy, settings)}
    for name, check, boxes in _boundary(Conditions(problem, policy, fit.spline, MARGIN), mesh):
        outcomes[name] = prove(check, boxes, MARGIN, settings.halvings)
    return Proof(
        spline=fit.spline,
        # W is not above its largest coefficient.
        margin=min(max(outcome.margin for outcome in outcomes.values()), fit.spline.coefficients.max().item()),
        resisted={name: outcome.left for name, outcome in outcomes.items() if not outcome.proved},
        boxes=sum(outcome.bounded for outcome in outcomes.values()),
        networks=networks,
        seconds=time.perf_counter() - started,
    )


def _fit_on_boxes(fit: Fit, problem: ReachAvoidProblem, policy: Any, settings: Settings) -> Outcome:
    """Raise the source where L^pi W >= 0 is not proved, until it is; the boxes that are left are those of all cells."""
    cells = everywhere = Boxes.cells(fit.mesh.edges)
    for number in range(1, settings.rounds + 1):
        announce(f"proving the bound, round {number}")
        conditions = Conditions(problem, policy, fit.spline, MARGIN)
        outcome = prove(conditions.interior, cells, MARGIN, settings.halvings)
        if outcome.proved and cells is everywhere:
            return outcome
        if outcome.proved:
            cells = everywhere
            continue
        if not fit.on_boxes(outcome.left, conditions.residual(outcome.left)):
            break
        # The source changes W little elsewhere. All cells are proved again in the end.
        cells = everywhere.around(outcome.left)
    return prove(Conditions(problem, policy, fit.spline, MARGIN).interior, everywhere, MARGIN, settings.halvings)


def _feedback(solution: Solution) -> Callable[[Any, Any], Any]:
    """The policy in double precision, of tensors or of affine forms tau (N,) and x (N, n)."""
    actor, controls = copy.deepcopy(solution.actor).cpu().double(), solution.problem.controls

    @torch.no_grad()
    def policy(tau: Tensor | Affine, x: Tensor | Affine):
        return controls.denormalize(actor(tau.unsqueeze(-1), x))

    return policy


def _boundary(conditions: Conditions, mesh: Mesh) -> list[Condition]:
    """The conditions at tau = 0, on the sides of the mesh, and on the faces of A and B."""
    cells, problem = Boxes.cells(mesh.edges), conditions.problem
    found: list[Condition] = [("tau = 0", conditions.start, cells.at_end(0, 0, -1))]
    for axis, last in enumerate(mesh.cells[1:]):
        for outward, cell in ((-1, 0), (1, last - 1)):

            def side(boxes: Boxes, axis: int = axis, outward: int = outward) -> tuple[Tensor, Tensor]:
                return conditions.side(boxes, axis, outward)

            name = f"the {'lower' if outward < 0 else 'upper'} side of coordinate {axis + 1}"
            found.append((name, side, cells.at_end(1 + axis, cell, outward)))
    for name, constraints, most in _sets(problem):
        for number in range(constraints(torch.zeros(1, problem.states.dim, dtype=torch.float64)).shape[-1]):

            def face(boxes: Boxes, constraints=constraints, number: int = number, most: float = most):
                return conditions.face(boxes, constraints, number, most)

            found.append((f"face {number + 1} of {name}", face, cells))
    return found


def _sets(problem: ReachAvoidProblem) -> list[tuple[str, Callable, float]]:
    """The sets at which paths end, with their constraints and their payoff."""
    sets = [("A", problem.reached_constraints, 1.0)] if problem.objective == "reach-avoid" else []
    return sets + ([("B", problem.avoid_constraints, 0.0)] if problem.has_avoid_set else [])
