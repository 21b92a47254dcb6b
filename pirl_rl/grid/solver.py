"""The solver: V and the policy of a problem on a mesh, by the steps of `pirl_rl.grid.march`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from pirl_rl.errors import ArgumentError
from pirl_rl.grid.candidates import candidates
from pirl_rl.grid.chain import Chain
from pirl_rl.grid.march import Continuation, March
from pirl_rl.grid.mesh import (
    LEAST_ACROSS,
    WIDER,
    Mesh,
    absorbed,
    default_margin,
    make_mesh,
    resolves_target,
    widest_margin,
)
from pirl_rl.grid.solution import GridSolution
from pirl_rl.grid.transport import FARTHEST, Transport, is_weak, noise_limit, speed_limit
from pirl_rl.problem import ReachAvoidProblem

POINTS = {1: 401, 2: 121, 3: 51}
"""Default numbers of nodes across `states` along each axis, by the number of states."""

MOST_STEPS = 6
"""The largest number of steps for each of the largest number of points, where it is chosen."""

FIRST = 2.0
"""The number of cells through which a control is held from tau = 0, where drift and noise act in turns."""

BROAD = 4.0
"""The largest deviation of the noise, in cells, in the time for which that control is held.

A drift that is slow everywhere would lead through two cells only after a long time, in which the best control changes
and noise that depends on the state does, too. A layer that is wider than a cell needs no held control.
"""

NOTICED, WIDESPREAD = 0.01, 0.05
"""A wider mesh is asked for where it changes V by more than the first at more than the second share of the nodes."""


class GridSolver:
    """Solves the HJB equation of a problem on a mesh.

    Args:
        problem: the physics, with at most three states.
        points: number of nodes across `problem.states` along each axis, at least 5; one number serves all axes. A part
            of A or B that is thinner than the distance of two nodes may be missed.
        steps: number of steps in tau, at least 2; the default is the largest number of points. With noise that is weak
            beside the mesh it is larger, up to `MOST_STEPS` times, where most paths would lead through more than two
            cells in a step: drift and noise can act in turns only with shorter steps, see `pirl_rl.grid.transport`.
        margin: how far the mesh goes beyond `problem.states` on each side, in SI units, one number for each axis. The
            default follows from drift, noise and horizon, see `pirl_rl.grid.mesh.default_margin`, but is at most
            `WIDEST`. Where it is limited so, and an estimate is asked for, V is compared with that of a wider mesh.
        levels: number of levels of each control among the candidates, at least 2; the default follows from the
            problem, see `pirl_rl.grid.candidates`.
        estimate: whether the problem is solved with half the points and steps, too, for an estimate of the error.
        turns: whether drift and noise may act in turns, where the noise is weak beside the mesh.

    Raises:
        ArgumentError: with the argument, what was expected and what was got.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        points: int | Sequence[int] | None = None,
        steps: int | None = None,
        margin: Sequence[float] | None = None,
        levels: int | None = None,
        estimate: bool = True,
        turns: bool = True,
    ):
        n = problem.states.dim
        if n not in POINTS:
            raise ArgumentError(f"problem: expected at most {max(POINTS)} states for a grid, got {n}")
        points = POINTS[n] if points is None else points
        self.points = (points,) * n if isinstance(points, int) else tuple(points)
        if len(self.points) != n or min(self.points) < 5:
            raise ArgumentError(f"points: expected an integer >= 5, or one for each of the {n} axes, got {points}")
        for name, number in (("steps", steps), ("levels", levels)):
            if number is not None and number < 2:
                raise ArgumentError(f"{name}: expected a number >= 2, got {number}")
        self.wanted = default_margin(problem) if margin is None else np.array(margin, float)
        self.margin = self.wanted if margin is not None else np.minimum(self.wanted, widest_margin(problem))
        if self.margin.shape != (n,) or not (self.margin >= 0).all():
            raise ArgumentError(f"margin: expected {n} numbers >= 0, got {margin}")
        for distance in (self.margin, self.wanted):
            distance[list(problem.states.periodic)] = 0.0  # a wider period would be another circle
        self.problem, self.steps, self.levels, self.estimate = problem, steps, levels, estimate
        self.turns = turns

    @property
    def resolves_target(self) -> bool:
        """Whether the target is wide enough, in nodes, for an estimate of the error; see `LEAST_ACROSS`."""
        return resolves_target(self.problem, self.points, self.margin)

    @torch.no_grad()
    def solve(self) -> GridSolution:
        """The value and the policy.

        Raises:
            ArgumentError: no node is outside A and B, or none is next to the target. With half the points this is a
                warning, and the estimate of the error is 1, which says that nothing is known of it.
        """
        if self.estimate and not self.resolves_target:
            warnings.warn(
                f"points: the target has fewer than {LEAST_ACROSS} nodes in a row along an axis with points="
                f"{self.points}, so that the estimate of the error can be far too small; expected more points",
                stacklevel=2,
            )
        solution = self._solved(self.points)
        if self.estimate:
            half = tuple(max((count + 1) // 2, 3) for count in self.points)
            # Both have the same scheme, or their distance would not be an estimate of the error.
            scheme = max(solution.steps // 2, 1), solution.split
            try:
                solution.coarse = self._solved(half, scheme)
                solution.unseen = self._beyond_margin(half, scheme, solution.coarse, solution.mesh)
            except ArgumentError as error:
                solution.unseen = np.ones(solution.mesh.size)
                warnings.warn(
                    f"the error of the grid is not known, and its estimate is 1, because half the points are too few "
                    f"({error}); expected more points than {self.points}",
                    stacklevel=2,
                )
        return solution

    def _beyond_margin(
        self, points: Sequence[int], scheme: tuple[int, bool], coarse: GridSolution, fine: Mesh
    ) -> np.ndarray | None:
        """The change of V (N,) at the horizon and the nodes of `fine`, if the mesh goes further beyond the box.

        It is None where the margin was not limited, or all nodes beyond it lie in A or B, and 0 beside faces, since by
        rounding a node on a face may lie in the set on one of both meshes alone. A large change is pointed out.
        """
        problem = self.problem
        margin = np.minimum(self.wanted, WIDER[problem.states.dim] * self.margin)
        if make_mesh(problem, points, margin).shape == coarse.mesh.shape:
            return None
        x = torch.from_numpy(fine.states(fine.indices()))
        tau, wider = torch.full((len(x),), problem.horizon, dtype=x.dtype), self._solved(points, scheme, margin)
        near = coarse.field.near_faces(x)
        change = (wider.field(tau, x) - coarse.field(tau, x)).abs().masked_fill(near, 0.0)
        inside = change[problem.states.contains(x) & problem.interior(x)]
        share = (inside > NOTICED).double().mean().item()
        if share > WIDESPREAD:
            warnings.warn(
                f"margin: the mesh goes beyond the box of states by {_listed(self.margin)}; with {_listed(margin)} V "
                f"changes by more than {NOTICED} at {share:.0%} of the nodes in the box, and by up to "
                f"{inside.max():.2g}; expected margin={_listed(self.wanted)}",
                stacklevel=3,
            )
        return change.numpy()

    def _solved(
        self, points: Sequence[int], scheme: tuple[int, bool] | None = None, margin: np.ndarray | None = None
    ) -> GridSolution:
        """The solution without an estimate.

        Args:
            points: the numbers of nodes across `problem.states` along each axis.
            scheme: the number of steps, and whether drift and noise act in turns; by default they follow from the
                problem and the mesh.
            margin: how far the mesh goes beyond `problem.states` (n,), in SI units, by default by `self.margin`.
        """
        problem, mesh = self.problem, make_mesh(self.problem, points, self.margin if margin is None else margin)
        nodes = mesh.states(mesh.indices())
        inside, fixed = absorbed(problem, nodes)
        free = np.flatnonzero(~inside)
        controls = candidates(problem, nodes[free], mesh.spacing, self.levels)
        steps, split = self._scheme(mesh, nodes[free], controls) if scheme is None else scheme
        chain = Chain(problem, mesh, free, controls, moves=not split)
        value = problem.boundary_value(torch.from_numpy(nodes[free])).numpy()
        if not (value.any() or any(arm.value.any() for pair in chain.axes for arm in pair)):
            raise ArgumentError(f"points: expected a mesh that meets the target, got none of its nodes with {points}")
        continued = Continuation(mesh, free, fixed, chain, bounded=split)
        values = np.empty((steps + 1, mesh.size), np.float32)
        policies = np.empty((steps + 1, len(free)), np.min_scalar_type(len(controls)))
        values[0] = continued(value)
        march = March(chain, continued, problem.horizon, steps)
        if split:
            transport = Transport(problem, mesh, nodes[free], controls, problem.horizon / steps)
            speed = speed_limit(problem, mesh, nodes[free], controls)
            # A smoothed payoff does not jump at tau = 0.
            held = min(FIRST / speed, BROAD**2 / noise_limit(problem, mesh, nodes[free], controls))
            first = 0 if problem.payoff.epsilon else min(math.ceil(held * steps / problem.horizon), steps)
            levels = march.in_turns(value, transport, first)
        else:
            levels = march.together(value)
        for level, field, policy in levels:
            values[level], policies[level] = field, policy
        policies[0] = policies[1]
        place = np.full(mesh.size, -1)
        place[free] = np.arange(len(free))
        around = distance_transform_edt(inside.reshape(mesh.shape), return_distances=False, return_indices=True)
        nearest = place[mesh.flat(np.moveaxis(np.asarray(around), 0, -1)).ravel()]
        return GridSolution(problem, mesh, values, policies, controls, nearest, split=split)

    def _scheme(self, mesh: Mesh, x: np.ndarray, controls: np.ndarray) -> tuple[int, bool]:
        """The number of steps, and whether drift and noise act in turns, at nodes x (M, n) with controls (K, M, m)."""
        steps = max(self.points) if self.steps is None else self.steps
        if not (self.turns and is_weak(self.problem, mesh, x, controls)):
            return steps, False
        if self.steps is None:
            # A force that grows outside the box of states, in the margin of the mesh, must not rule the steps out.
            most, parts = MOST_STEPS * steps, (slice(None), self._in_box(x))
        else:
            most, parts = steps, (slice(None),)
        for kept in parts:
            speed = speed_limit(self.problem, mesh, x[kept], controls[:, kept])
            needed = math.ceil(self.problem.horizon * speed / FARTHEST)
            if needed <= most:
                return max(steps, needed), True
        return steps, False

    def _in_box(self, x: np.ndarray) -> np.ndarray:
        """Which of the nodes x (M, n) lie in the box of states (M,); all of them if none does."""
        inside = self.problem.states.contains(torch.from_numpy(x)).numpy()
        return inside | (not inside.any())


def _listed(margin: np.ndarray) -> list[float]:
    """The numbers of a margin (n,) for a message."""
    return [float(f"{distance:.3g}") for distance in margin]
