"""Transport of V along the flow without noise, for meshes that are coarse beside weak noise.

A jump of the chain is as long as the distance h of two nodes. Where the noise sigma is so weak that h |f| > sigma^2 the
scheme is upwind, and adds a noise of its own of the variance h |f| per unit of time. There each step of the length dt
has two parts instead. First V moves along the flow,

    W(x) = max_u V(tau, x(dt; u)),   dx/dt = f(x, u),   x(0) = x,

a semi-Lagrangian step (M. Falcone and R. Ferretti, Semi-Lagrangian Approximation Schemes for Linear and Hamilton-Jacobi
Equations, SIAM, 2013), where a path that enters A or B on its way has their value. Then the noise acts for the time dt,
by the chain without drift. Between nodes V is a cubic spline that is limited to the values at the corners of the cell
(R. Bermejo and A. Staniforth, Monthly Weather Review 120, 1992), so that it stays in [0, 1]. In a cell that a face cuts
V follows from a short path, see `after_a_cell`.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import torch
from scipy.ndimage import map_coordinates, spline_filter
from torch import Tensor

from pirl_rl.crossings import passage_probability
from pirl_rl.grid.mesh import Mesh, absorbed
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.structure import has_controlled_noise

WEAK = 2.0
"""h |f| / sigma^2 along an axis, from which the noise is weak beside the mesh: there the chain is upwind."""

FARTHEST = 2.0
"""The largest number of cells through which a path goes while its control is held."""

PADDING = 8
"""Nodes by which periodic axes are continued at both ends, where a cubic spline forgets its ends."""

LOOKS = 2
"""The number of looks for A and B on a path through one cell."""

STEPS_OF_A_CELL = 8
"""The number of steps in which `after_a_cell` follows a path."""

GAIN = 1e-9
"""The gain of V by which a candidate must exceed those before it."""


def can_split(problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray, controls: np.ndarray, dt: float) -> bool:
    """Whether drift and noise should act in turns of dt, at nodes x (M, n) and with controls (K, M, m).

    The noise must be weak beside the mesh at most of the nodes, and no path may cross more than `FARTHEST` cells in a
    turn, during which the control is held. Noise that depends on the control cannot act in a turn of its own.
    """
    if has_controlled_noise(problem):
        return False
    points, control = torch.from_numpy(x), torch.from_numpy(np.ascontiguousarray(controls[0]))
    variance = (problem.diffusion(points, control).numpy() / mesh.spacing[:, None]) ** 2
    drift = np.abs(problem.drift(points, control).numpy() / mesh.spacing)
    weak = ((drift > WEAK * variance.sum(-1)).any(-1)).mean() > 0.5
    farthest = max(
        np.abs(problem.drift(points, torch.from_numpy(u.copy())).numpy() / mesh.spacing).max() for u in controls
    )
    return bool(weak and farthest * dt <= FARTHEST)


class Transport:
    """Moves V along the flow under the best candidate control.

    Args:
        problem: the physics.
        mesh: the nodes.
        x: states (M, n) of the nodes outside A and B.
        controls: candidate controls (K, M, m), in SI units.
        dt: the length of a step, in s.
    """

    def __init__(self, problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray, controls: np.ndarray, dt: float):
        self._mesh = mesh
        points = torch.from_numpy(x)
        self._feet = [_foot(problem, mesh, points, torch.from_numpy(np.ascontiguousarray(u)), dt) for u in controls]

    def __call__(self, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """W (M,) and the numbers (M,) of the best candidates, from V (N,) at all nodes, continued into A and B."""
        padded = self._padded(field)
        spline = spline_filter(padded, order=3, mode="mirror")
        value, best = np.array(-np.inf), np.array(0)
        for number, (place, ended, end) in enumerate(self._feet):
            low, high = _corners(padded, place)
            moved = map_coordinates(spline, place, order=3, prefilter=False, mode="nearest").clip(low, high)
            moved = np.where(ended, end, moved).clip(0, 1)
            better = moved > value + GAIN
            value, best = np.where(better, moved, value), np.where(better, number, best)
        return value, best

    def _padded(self, field: np.ndarray) -> np.ndarray:
        field = field.reshape(self._mesh.shape)
        for axis in range(field.ndim):
            width = [(0, 0)] * field.ndim
            width[axis] = (PADDING, PADDING)
            field = np.pad(field, width, mode="wrap" if axis in self._mesh.periodic else "edge")
        return field


def after_a_cell(
    problem: ReachAvoidProblem,
    spacing: Tensor,
    policy: Callable[[Tensor, Tensor], Tensor],
    value: Callable[[Tensor, Tensor], Tensor],
    tau: Tensor,
    x: Tensor,
) -> Tensor:
    """V (P,) at states outside A and B, from that where the flow is one cell further.

    On the way the noise may cross a face. Its level is taken as Brownian motion with the drift of the whole way, see
    `pirl_rl.crossings.passage_probability`. Paths that cross a face of A and one of B count as failures.

    Args:
        problem: the physics.
        spacing: the distances (n,) of the nodes, in SI units.
        policy: gives the controls, in SI units, at tau and x.
        value: gives V between the nodes, continued into A and B, at tau and x.
        tau: times to go (P,), in s.
        x: states (P, n), in SI units.
    """
    sets = []
    if problem.has_avoid_set:
        sets.append((problem.avoid_constraints, False))
    if problem.objective == "reach-avoid":
        sets.append((problem.reached_constraints, True))
    u = policy(tau, x)
    rate = problem.drift(x, u).abs() / spacing
    length = torch.minimum(tau, 1 / rate.amax(-1).clamp(min=1e-12))
    moved, left, h = x, tau, length / STEPS_OF_A_CELL
    for _ in range(STEPS_OF_A_CELL):
        moved = problem.states.wrap(moved + problem.drift(moved, policy(left, moved)) * h.unsqueeze(-1))
        left = (left - h).clamp(min=0)
    sigma, under_way, result = problem.diffusion(x, u), torch.ones_like(tau), torch.zeros_like(tau)
    for constraints, reached in sets:
        crossed = passage_probability(constraints, x, moved, sigma, length)
        # All constraints of A must hold, and one of B suffices.
        ended = under_way * (crossed.amin(-1) if reached else 1 - (1 - crossed).prod(-1))
        under_way, result = under_way - ended, result + (ended if reached else 0)
    return result + under_way * value(left, moved)


def _foot(problem: ReachAvoidProblem, mesh: Mesh, x: torch.Tensor, u: torch.Tensor, dt: float):
    """Where paths without noise from x (M, n) end after dt.

    Returns:
        Positions (n, M) in the padded mesh, whether the paths ended in A or B before (M,), and the value there (M,).
    """
    cells = np.abs(problem.drift(x, u).numpy() / mesh.spacing).max() * dt
    looks = max(1, int(np.ceil(LOOKS * cells)))
    h, ended, end = dt / looks, np.zeros(len(x), bool), np.zeros(len(x))
    for _ in range(looks):
        middle = x + problem.drift(x, u) * (h / 2)
        x = x + problem.drift(middle, u) * h
        inside, value = absorbed(problem, problem.states.wrap(x).numpy())
        end = np.where(inside & ~ended, value, end)
        ended = ended | inside
    place = ((x.numpy() - mesh.low) / mesh.spacing).T
    for axis, count in enumerate(mesh.shape):
        place[axis] = place[axis] % count if axis in mesh.periodic else place[axis].clip(0, count - 1)
    return place + PADDING, ended, end


def _corners(field: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest value (M,) at the corners of the cells of positions (n, M)."""
    base = np.floor(place).astype(int)
    low, high = np.full(place.shape[1], np.inf), np.full(place.shape[1], -np.inf)
    for offset in product((0, 1), repeat=len(base)):
        value = field[tuple(base + np.array(offset)[:, None])]
        low, high = np.minimum(low, value), np.maximum(high, value)
    return low, high
