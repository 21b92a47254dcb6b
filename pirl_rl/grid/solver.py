"""The solver: implicit Euler steps in tau, each solved by policy iteration (R. Howard 1960).

A step from V' to V solves V - dt max_u {rates(u) V + gain(u)} = V', and an error r of this equation is an error of at
most |r| in V, because the scheme is monotone. The steps are equidistant in sqrt(tau), since V changes fastest where
tau is small.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import LinearOperator, bicgstab, spsolve

from pirl_rl.errors import ArgumentError
from pirl_rl.grid.candidates import candidates
from pirl_rl.grid.chain import Chain
from pirl_rl.grid.mesh import Mesh, absorbed, default_margin, make_mesh
from pirl_rl.grid.solution import GridSolution
from pirl_rl.grid.transport import FARTHEST, Transport, is_weak, speed_limit
from pirl_rl.problem import ReachAvoidProblem

POINTS = {1: 401, 2: 121, 3: 51}
"""Default numbers of nodes across `states` along each axis, by the number of states."""

MOST_STEPS = 6
"""The largest number of steps for each of the largest number of points, where it is chosen."""

FIRST = 2.0
"""The number of cells through which a control is held from tau = 0, where drift and noise act in turns."""

TOLERANCE = 1e-7
"""The largest error of the equation of one step."""

ITERATIONS = 50
"""The largest number of policy iterations in a step; two or three are usual."""

TURNS = 3
"""The number of policy iterations in a step in which drift and noise act in turns: the next step goes on from there."""

GAIN = 1e-6
"""Where drift and noise act in turns: the gain of V for which a node gives up the candidate that it had one step
before. V itself is known to `TOLERANCE`."""

LEAST_FRACTION = 0.05
"""V is continued into A and B along arms at least this long, as the slope along shorter ones is mostly rounding."""


Level = tuple[int, np.ndarray, np.ndarray]
"""The number of a time to go, V (N,) at all nodes, and the numbers (M,) of the best candidates."""


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
            default follows from drift, noise and horizon, see `pirl_rl.grid.mesh.default_margin`.
        levels: number of levels of each control among the candidates, at least 2; the default follows from the
            problem, see `pirl_rl.grid.candidates`.
        estimate: whether the problem is solved with half the points and steps, too, for an estimate of the error.

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
    ):
        n = problem.states.dim
        if n not in POINTS:
            raise ArgumentError(f"problem: expected at most {max(POINTS)} states for a grid, got {n}")
        points = POINTS[n] if points is None else points
        self.points = (points,) * n if isinstance(points, int) else tuple(points)
        if len(self.points) != n or min(self.points) < 5:
            raise ArgumentError(f"points: expected {n} numbers >= 5, or one, got {points}")
        for name, number in (("steps", steps), ("levels", levels)):
            if number is not None and number < 2:
                raise ArgumentError(f"{name}: expected a number >= 2, got {number}")
        self.margin = default_margin(problem) if margin is None else np.array(margin, float)
        if self.margin.shape != (n,) or not (self.margin >= 0).all():
            raise ArgumentError(f"margin: expected {n} numbers >= 0, got {margin}")
        self.problem, self.steps, self.levels, self.estimate = problem, steps, levels, estimate

    @torch.no_grad()
    def solve(self) -> GridSolution:
        """The value and the policy.

        Raises:
            ArgumentError: no node is outside A and B, or none is next to the target.
        """
        solution = self._solved(self.points)
        if self.estimate:
            half = tuple(max((count + 1) // 2, 3) for count in self.points)
            # Both have the same scheme, or their distance would not be an estimate of the error.
            solution.coarse = self._solved(half, (max(solution.steps // 2, 1), solution.split))
        return solution

    def _solved(self, points: Sequence[int], scheme: tuple[int, bool] | None = None) -> GridSolution:
        """The solution without an estimate.

        Args:
            points: the numbers of nodes across `problem.states` along each axis.
            scheme: the number of steps, and whether drift and noise act in turns; by default they follow from the
                problem and the mesh.
        """
        problem, mesh = self.problem, make_mesh(self.problem, points, self.margin)
        nodes = mesh.states(mesh.indices())
        inside, fixed = absorbed(problem, nodes)
        free = np.flatnonzero(~inside)
        controls = candidates(problem, nodes[free], mesh.spacing, self.levels)
        steps, split = self._scheme(mesh, nodes[free], controls) if scheme is None else scheme
        chain = Chain(problem, mesh, free, controls, moves=not split)
        value = problem.boundary_value(torch.from_numpy(nodes[free])).numpy()
        if not (value.any() or any(arm.value.any() for pair in chain.axes for arm in pair)):
            raise ArgumentError(f"points: expected a mesh that meets the target, got none of its nodes with {points}")
        continued = _Continuation(mesh, free, fixed, chain, bounded=split)
        values = np.empty((steps + 1, mesh.size), np.float32)
        policies = np.empty((steps + 1, len(free)), np.min_scalar_type(len(controls)))
        values[0] = continued(value)
        if split:
            transport = Transport(problem, mesh, nodes[free], controls, problem.horizon / steps)
            speed = speed_limit(problem, mesh, nodes[free], controls)
            # A smoothed payoff does not jump at tau = 0.
            first = 0 if problem.payoff.epsilon else math.ceil(FIRST * steps / (problem.horizon * speed))
            march = _in_turns(chain, transport, continued, value, problem.horizon, steps, first)
        else:
            march = _together(chain, continued, value, problem.horizon, steps)
        for level, field, policy in march:
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
        if not is_weak(self.problem, mesh, x, controls):
            return steps, False
        needed = math.ceil(self.problem.horizon * speed_limit(self.problem, mesh, x, controls) / FARTHEST)
        most = MOST_STEPS * steps if self.steps is None else steps
        return (max(steps, needed), True) if needed <= most else (steps, False)


def _together(chain: Chain, continued: _Continuation, value: np.ndarray, horizon: float, steps: int) -> Iterator[Level]:
    """Steps in which drift and noise act at once, from V (M,) at tau = 0: equal ones in sqrt(tau)."""
    policy = np.zeros(len(value), int)
    for level, share in enumerate(np.diff(np.linspace(0, 1, steps + 1) ** 2), start=1):
        value, policy = _advance(chain, value, policy, horizon * share)
        yield level, continued(value), policy


def _in_turns(
    chain: Chain,
    transport: Transport,
    continued: _Continuation,
    value: np.ndarray,
    horizon: float,
    steps: int,
    first: int,
) -> Iterator[Level]:
    """Steps in which drift and noise act in turns, from V (M,) at tau = 0.

    Their lengths are equal, so that their paths are the same. V is noted at the times of all solutions. In the `first`
    steps V is that of a control that is held, where the noise acts on the faces.
    """
    noisy = transport.noise_acts_on_faces()
    after, policy, times = continued(value), np.zeros(len(value), int), steps * np.linspace(0, 1, steps + 1) ** 2
    for step in range(steps):
        before = after
        policy, moved = _turn(chain, transport, after, policy, horizon / steps)
        value = _solve(chain, moved, moved, policy, horizon / steps)
        if step < first:
            held, best = transport.first(step + 1)
            value, policy = np.where(noisy, held, value), np.where(noisy, best, policy)
        after = continued(value)
        within = times - step
        for level in np.flatnonzero((within > 0) & (within <= 1)):
            yield int(level), (1 - within[level]) * before + within[level] * after, policy


def _turn(
    chain: Chain, transport: Transport, field: np.ndarray, policy: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """The best policy (M,) of a step in turns from V (N,) at all nodes, and V (M,) at the ends of its paths.

    Where candidates are equally good a node keeps the one of `policy` (M,), with which V rose there.
    """
    seen, nodes = transport.seen(field), np.arange(len(policy))
    if chain.shared:
        best = seen.argmax(0)
        value = transport.moved(field, best, policy).max(0)
        return np.where(seen[best, nodes] > seen[policy, nodes] + GAIN, best, policy), value
    value = seen[policy, nodes]
    for turn in range(TURNS):
        if turn:
            value = _solve(chain, seen[policy, nodes], value, policy, dt)
        scores = seen + dt * chain.generator(value)
        best = scores.argmax(0)
        policy = np.where(scores[best, nodes] > scores[policy, nodes] + GAIN, best, policy)
    return policy, transport.moved(field, policy)[0]


def _advance(chain: Chain, before: np.ndarray, policy: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """V (M,) and the policy (M,) one step after `before` (M,), by policy iteration from `policy` (M,)."""
    value, nodes = before, np.arange(len(before))
    for iteration in range(ITERATIONS):
        rates = chain.generator(value)
        better = rates.argmax(0)
        gained = rates[better, nodes] - rates[policy, nodes]
        if iteration and dt * gained.max() <= TOLERANCE:
            break
        # A candidate that is as good as the present one does not replace it, so that the iteration cannot alternate.
        policy = np.where(dt * gained > TOLERANCE / 10, better, policy)
        value = _solve(chain, before, value, policy, dt)
    return value, policy


def _solve(chain: Chain, before: np.ndarray, guess: np.ndarray, policy: np.ndarray, dt: float) -> np.ndarray:
    """V (M,) of a policy (M,) after one implicit step from `before` (M,)."""
    rates, gain = chain.of(policy)
    matrix = sparse.eye_array(len(before), format="csr") - dt * rates
    right, diagonal = before + dt * gain, matrix.diagonal()
    scaling = LinearOperator(matrix.shape, matvec=lambda residual: residual / diagonal)  # type: ignore[call-arg]
    value, failed = bicgstab(matrix, right, guess, rtol=0.0, atol=TOLERANCE, maxiter=1000, M=scaling)
    return np.asarray(spsolve(matrix.tocsc(), right) if failed else value)


class _Continuation:
    """Continues V linearly from the nodes outside A and B through a face to the next nodes inside.

    Interpolation between both then has the value of the set at the face. Where the node outside is very near the face
    the line may leave [0, 1] by far, and a spline through it oscillates. `bounded` keeps it in [0, 1].
    """

    def __init__(self, mesh: Mesh, free: np.ndarray, fixed: np.ndarray, chain: Chain, bounded: bool):
        inside = np.ones(mesh.size, bool)
        inside[free] = False
        self._free, self._fixed, self._bounded, self._arms = free, fixed, bounded, []
        self._count = np.zeros(mesh.size)
        for arm in (arm for pair in chain.axes for arm in pair):
            ends = np.flatnonzero(arm.cut & inside[arm.node])
            self._arms.append((ends, arm.node[ends], arm.value[ends], arm.fraction[ends].clip(LEAST_FRACTION)))
            np.add.at(self._count, arm.node[ends], 1)

    def __call__(self, value: np.ndarray) -> np.ndarray:
        """V (N,) at all nodes from V (M,) at the nodes outside A and B."""
        total = np.zeros(len(self._fixed))
        for start, node, end, fraction in self._arms:
            total += np.bincount(node, value[start] + (end - value[start]) / fraction, len(total))
        result = np.where(self._count > 0, total / np.maximum(self._count, 1), self._fixed)
        result[self._free] = value
        return result.clip(0, 1) if self._bounded else result
