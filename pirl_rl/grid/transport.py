"""Transport of V along the flow without noise, for meshes that are coarse beside weak noise.

A jump of the chain is as long as the distance h of two nodes. Where the noise sigma is so weak that h |f| > sigma^2 the
scheme is upwind, and adds a noise of its own of the variance h |f| per unit of time. Where h |f| > `WEAK` sigma^2 at
most of the nodes, each step of the length dt has three parts instead (Strang splitting). In the first and in the last
the noise acts for dt / 2, by the chain without drift. In between V moves along the flow,

    W(x) = max_u V(tau, x(dt; u)),   dx/dt = f(x, u),   x(0) = x,

a semi-Lagrangian step (M. Falcone and R. Ferretti, Semi-Lagrangian Approximation Schemes for Linear and Hamilton-Jacobi
Equations, SIAM, 2013), where a path that enters A or B on its way has their value. Between nodes V is a
cubic spline that is limited to the values at the corners of the cell (R. Bermejo and A. Staniforth, Monthly Weather
Review 120, 1992), so that it stays in [0, 1].

Where sigma depends on u, the control of a step must be the best one for drift and noise. A node that plays u has

    V(x) - dt L_u V(x) = W_u(x),   W_u(x) = V(tau, x(dt; u)),

with the generator L_u of the noise alone, and the best u follows by policy iteration.

At tau = 0 V jumps at the faces, and in the short time sigma^2 / |f|^2 the noise makes layers there that are thinner
than a cell. A path that the flow leads to a face has crossed it earlier, on average, than at its end alone, and V keeps
this lead for good. So in the first steps V is the probability of entering A, or of not entering B for invariance, while
a control is held, see `pirl_rl.passages.entrance_probability`.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter, spline_filter

from pirl_rl.crossings import squared_noise
from pirl_rl.grid.mesh import Mesh, absorbed, finite
from pirl_rl.passages import entrance_probability, passage_probability
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import midpoint_drift
from pirl_rl.structure import has_controlled_noise

WEAK = 2.0
"""h |f| / sigma^2 along an axis, from which the noise is weak beside the mesh: there the chain is upwind."""

FARTHEST = 2.0
"""The largest number of cells through which most paths go while their control is held."""

PADDING = 8
"""Nodes by which periodic axes are continued at both ends, where a cubic spline forgets its ends."""

LOOKS = 2
"""The number of looks for A and B on a path through one cell."""

MOST_LOOKS = 1_000
"""The largest number of looks in a step: no path is followed through more than 500 cells. Most go through two at most,
and only nodes with large forces, as in the margin of the mesh, ask for more."""

BLUR = 1.0
"""The standard deviation, in cells, of the filter through which candidates see V."""


def is_weak(problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray, controls: np.ndarray) -> bool:
    """Whether the noise is weak beside the mesh at most of the nodes x (M, n), with controls (K, M, m).

    The largest drift of all controls is compared with the largest variance of the noise.
    """
    points, variance, drift = torch.from_numpy(x), np.zeros_like(x), np.zeros_like(x)
    for u in controls:
        control = torch.from_numpy(np.ascontiguousarray(u))
        sigma = finite(problem.diffusion(points, control)) / mesh.spacing[:, None]
        variance = np.maximum(variance, (sigma**2).sum(-1))
        drift = np.maximum(drift, np.abs(finite(problem.drift(points, control)) / mesh.spacing))
    return bool((drift > WEAK * variance).any(-1).mean() > 0.5)


def speed_limit(problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray, controls: np.ndarray) -> float:
    """The number of cells per s through which nine in ten paths lead, at most, from nodes x (M, n) with controls
    (K, M, m).

    The fastest of all would make steps too short, where a few states have large forces.
    """
    points = torch.from_numpy(x)
    drifts = (finite(problem.drift(points, torch.from_numpy(np.ascontiguousarray(u)))) for u in controls)
    return max(float(np.quantile([np.abs(drift / mesh.spacing).max(-1) for drift in drifts], 0.9)), 1e-12)


def noise_limit(problem: ReachAvoidProblem, mesh: Mesh, x: np.ndarray, controls: np.ndarray) -> float:
    """The variance of the noise, in squared cells per s, that nine in ten nodes x (M, n) have at most, along the axis
    and with the control (K, M, m) with the most noise."""
    points = torch.from_numpy(x)
    sigmas = (finite(problem.diffusion(points, torch.from_numpy(np.ascontiguousarray(u)))) for u in controls)
    variances = [((sigma / mesh.spacing[:, None]) ** 2).sum(-1).max(-1) for sigma in sigmas]
    return max(float(np.quantile(variances, 0.9)), 1e-12)


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
        self._problem, self._x, self._dt = problem, torch.from_numpy(x), dt
        self._controls = [torch.from_numpy(np.ascontiguousarray(u)) for u in controls]
        self._feet = []
        for u in self._controls:
            moved, ended, end = _flow(problem, mesh, self._x, u, dt)
            self._feet.append((_place(mesh, moved), ended, end))

    def first(self, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """V (M,) a few steps after tau = 0, while the best candidate is held, and the number (M,) of that candidate."""
        value, best = np.full(len(self._x), -1.0), np.zeros(len(self._x), int)
        for number, u in enumerate(self._controls):
            moved, ended, end = _flow(self._problem, self._mesh, self._x, u, steps * self._dt)
            passed = _passed(self._problem, self._x, moved, u, steps * self._dt, ended, end)
            best, value = np.where(passed > value, number, best), np.maximum(passed, value)
        return value, best

    def noise_acts_on_faces(self) -> np.ndarray:
        """Whether the noise moves every level of A that is above 0, or the level of B for invariance, (M,) bool."""
        tried = self._controls if has_controlled_noise(self._problem) else self._controls[:1]
        return np.all([_noise_acts_on_faces(self._problem, self._x, u) for u in tried], axis=0)

    def seen(self, field: np.ndarray) -> np.ndarray:
        """What each candidate is worth (K, M), judged by a V that is blurred over a cell.

        With weak noise V is 1 in whole regions, whatever the next control is, until a path comes to the edge of the
        region, where the right control must be exact. A blurred V shows the edge before.

        Args:
            field: V (N,) at all nodes, continued into A and B.
        """
        blurred, seen = gaussian_filter(self._padded(field), BLUR, mode="nearest"), []
        for place, ended, end in self._feet:
            seen.append(np.where(ended, end, map_coordinates(blurred, place, order=1, prefilter=False, mode="nearest")))
        return np.stack(seen)

    def moved(self, field: np.ndarray, *policies: np.ndarray) -> np.ndarray:
        """V (k, M) at the ends of the paths of k policies, each given as the numbers (M,) of candidates.

        Args:
            field: V (N,) at all nodes, continued into A and B.
            policies: the numbers (M,) of the candidates of each policy.
        """
        padded = self._padded(field)
        spline = spline_filter(padded, order=3, mode="mirror")
        # The smallest and the largest value at the corners of each cell, noted at its first corner.
        low, high = (extreme(padded, size=2, origin=-1) for extreme in (minimum_filter, maximum_filter))
        values = []
        for policy in policies:
            place, stopped = np.empty((padded.ndim, len(policy))), np.full(len(policy), np.nan)
            for number, (foot, ended, end) in enumerate(self._feet):
                chosen = policy == number
                place[:, chosen] = foot[:, chosen]
                stopped[chosen & ended] = end[chosen & ended]
            cell = tuple(np.floor(place).astype(int))
            moved = map_coordinates(spline, place, order=3, prefilter=False, mode="nearest").clip(low[cell], high[cell])
            values.append(np.where(np.isnan(stopped), moved, stopped).clip(0, 1))
        return np.stack(values)

    def _padded(self, field: np.ndarray) -> np.ndarray:
        field = field.reshape(self._mesh.shape)
        for axis in range(field.ndim):
            width = [(0, 0)] * field.ndim
            width[axis] = (PADDING, PADDING)
            field = np.pad(field, width, mode="wrap" if axis in self._mesh.periodic else "edge")
        return field


def _noise_acts_on_faces(problem: ReachAvoidProblem, x: torch.Tensor, u: torch.Tensor) -> np.ndarray:
    """`Transport.noise_acts_on_faces` for the control u (M, m) at x (M, n)."""
    sigma = problem.diffusion(x, u)
    if problem.objective != "reach-avoid":
        return (squared_noise(lambda y: problem.avoid_level(y).unsqueeze(-1), x, sigma, 1)[:, 0] > 0).numpy()
    levels = problem.target_constraints(x)
    moved = squared_noise(problem.target_constraints, x, sigma, levels.shape[-1]) > 0
    return (moved | (levels <= 0)).all(-1).numpy()


@torch.no_grad()
def _flow(problem: ReachAvoidProblem, mesh: Mesh, x: torch.Tensor, u: torch.Tensor, dt: float):
    """Where paths without noise from x (M, n) are after dt.

    A path fails where the drift leads to no number, unless it has entered A or B before.

    Returns:
        The states (M, n) within their periods, whether the paths ended in A or B or without a number before (M,), and
        the value of the first of these (M,).
    """
    wrap, spacing = problem.states.wrap, torch.from_numpy(mesh.spacing)
    cells = np.abs(finite(problem.drift(x, u)) / mesh.spacing).max() * dt
    looks = max(1, int(np.ceil(min(LOOKS * cells, MOST_LOOKS))))
    h, ended, end = dt / looks, np.zeros(len(x), bool), np.zeros(len(x))
    for _ in range(looks):
        way = midpoint_drift(problem, x, u, problem.drift(x, u), h) * h
        if LOOKS * cells > MOST_LOOKS:
            # Longer ways would lead past the place to which a large force drives, and past sets.
            way = way / (LOOKS * way / spacing).abs().amax(-1, keepdim=True).clamp(min=1)
        moved = wrap(x + way)
        # The drift need not have a number everywhere, as that of a tank below its bottom.
        lost = ~moved.isfinite().all(-1)
        x = torch.where(lost.unsqueeze(-1), x, moved)
        inside, value = absorbed(problem, x.numpy())
        end = np.where(inside & ~ended, value * ~lost.numpy(), end)
        ended = ended | inside | lost.numpy()
    return x, ended, end


def _place(mesh: Mesh, x: torch.Tensor) -> np.ndarray:
    """The positions (n, M) of states x (M, n) in the padded mesh."""
    place = ((x.numpy() - mesh.low) / mesh.spacing).T
    for axis, count in enumerate(mesh.shape):
        place[axis] = place[axis] % count if axis in mesh.periodic else place[axis].clip(0, count - 1)
    return place + PADDING


def _passed(
    problem: ReachAvoidProblem,
    x: torch.Tensor,
    moved: torch.Tensor,
    u: torch.Tensor,
    dt: float,
    ended: np.ndarray,
    end: np.ndarray,
) -> np.ndarray:
    """The probability (M,) that paths from x (M, n) have succeeded after dt, with what `_flow` gives of them.

    Paths that the flow leads into a set and out of it again have its value.
    """
    path, within = (x, moved, problem.diffusion(x, u), torch.full_like(x[:, 0], dt)), problem.states.within_period
    if problem.objective == "reach-avoid":
        avoid = within(problem.avoid_constraints) if problem.has_avoid_set else None
        succeeded = entrance_probability(within(problem.target_constraints), avoid, *path)
    else:
        succeeded = (1 - passage_probability(within(problem.avoid_constraints), *path)).prod(-1)
    inside = torch.where(torch.from_numpy(end > 0), problem.reached(moved), problem.failed(moved))
    return np.where(ended & ~inside.numpy(), end, finite(succeeded))
