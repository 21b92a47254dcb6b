"""Transport of V along the flow without noise, for meshes that are coarse beside weak noise.

A jump of the chain is as long as the distance h of two nodes. Where the noise sigma is so weak that h |f| > sigma^2 the
scheme is upwind, and adds a noise of its own of the variance h |f| per unit of time. There each step of the length dt
has two parts instead. First V moves along the flow,

    W(x) = max_u V(tau, x(dt; u)),   dx/dt = f(x, u),   x(0) = x,

a semi-Lagrangian step (M. Falcone and R. Ferretti, Semi-Lagrangian Approximation Schemes for Linear and Hamilton-Jacobi
Equations, SIAM, 2013), where a path that enters A or B on its way has their value. Then the noise acts for the time dt,
by the chain without drift. Between nodes V is a cubic spline that is limited to the values at the corners of the cell
(R. Bermejo and A. Staniforth, Monthly Weather Review 120, 1992), so that it stays in [0, 1]. In a cell that a face cuts
V follows from a short path, see `pirl_rl.grid.faces`.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter, spline_filter

from pirl_rl.grid.mesh import Mesh, absorbed
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.structure import has_controlled_noise

WEAK = 2.0
"""h |f| / sigma^2 along an axis, from which the noise is weak beside the mesh: there the chain is upwind."""

FARTHEST = 2.0
"""The largest number of cells through which most paths go while their control is held."""

PADDING = 8
"""Nodes by which periodic axes are continued at both ends, where a cubic spline forgets its ends."""

LOOKS = 2
"""The number of looks for A and B on a path through one cell."""

BLUR = 1.0
"""The standard deviation, in cells, of the filter through which candidates see V."""

GAIN = 1e-6
"""The gain of V for which a node gives up the candidate that it had one step before; V itself is known to 1e-7."""


def is_weak(problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray, controls: np.ndarray) -> bool:
    """Whether the noise is weak beside the mesh at most of the nodes x (M, n), with controls (K, M, m).

    Noise that depends on the control cannot act in a turn of its own, and counts as strong.
    """
    if has_controlled_noise(problem):
        return False
    points, control = torch.from_numpy(x), torch.from_numpy(np.ascontiguousarray(controls[0]))
    variance = (problem.diffusion(points, control).numpy() / mesh.spacing[:, None]) ** 2
    drift = np.abs(problem.drift(points, control).numpy() / mesh.spacing)
    return bool(((drift > WEAK * variance.sum(-1)).any(-1)).mean() > 0.5)


def longest_step(problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray, controls: np.ndarray) -> float:
    """The longest step, in s, in which most paths lead through at most `FARTHEST` cells.

    One in ten of the paths from nodes x (M, n) with controls (K, M, m) may lead through more of them. Otherwise a few
    states with large forces would make the steps of all too short.
    """
    points = torch.from_numpy(x)
    drifts = (problem.drift(points, torch.from_numpy(np.ascontiguousarray(u))).numpy() for u in controls)
    fastest = np.quantile([np.abs(drift / mesh.spacing).max(-1) for drift in drifts], 0.9)
    return FARTHEST / max(fastest, 1e-12)


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

    def __call__(self, field: np.ndarray, policy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """V one step further, and its policy.

        With weak noise V is 1 in whole regions, whatever the next control is, until a path comes to the edge of the
        region, where the right control must be exact. So candidates are compared by a V that is blurred over a cell,
        which shows the edge before, and where they are equal a node keeps the control with which V rose there.

        Args:
            field: V (N,) at all nodes, continued into A and B.
            policy: the numbers (M,) of the best candidates at a time to go that is one step shorter.

        Returns:
            W (M,), and the numbers (M,) of the best candidates.
        """
        padded = self._padded(field)
        spline, blurred = spline_filter(padded, order=3, mode="mirror"), gaussian_filter(padded, BLUR, mode="nearest")
        # The smallest and the largest value at the corners of each cell, noted at its first corner.
        low, high = (extreme(padded, size=2, origin=-1) for extreme in (minimum_filter, maximum_filter))
        value, best, seen = np.zeros(len(policy)), policy, np.full(len(policy), -np.inf)
        kept = np.zeros(len(policy))
        for number, (place, ended, end) in enumerate(self._feet):
            cell = tuple(np.floor(place).astype(int))
            moved = map_coordinates(spline, place, order=3, prefilter=False, mode="nearest").clip(low[cell], high[cell])
            value = np.maximum(value, np.where(ended, end, moved).clip(0, 1))
            vague = np.where(ended, end, map_coordinates(blurred, place, order=1, prefilter=False, mode="nearest"))
            kept = np.where(policy == number, vague, kept)
            best, seen = np.where(vague > seen, number, best), np.maximum(vague, seen)
        return value, np.where(seen > kept + GAIN, best, policy)

    def _padded(self, field: np.ndarray) -> np.ndarray:
        field = field.reshape(self._mesh.shape)
        for axis in range(field.ndim):
            width = [(0, 0)] * field.ndim
            width[axis] = (PADDING, PADDING)
            field = np.pad(field, width, mode="wrap" if axis in self._mesh.periodic else "edge")
        return field


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
