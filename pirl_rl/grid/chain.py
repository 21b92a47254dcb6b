"""The Markov chain of each candidate control: its jump rates between nodes and into A and B.

The covariance per unit of time, in units of the mesh, is a sum of lambda_k v_k v_k^T over whole offsets v_k, see
`pirl_rl.grid.stencil`. Let p and q in (0, 1] be the fractions of v_k and of -v_k that a straight path covers before it
enters A or B; they are 1 where it does not. The rates forward and backward are

    lambda_k (1 + c_k q) / (p (p + q)),   lambda_k (1 - c_k p) / (q (p + q)),

second differences with unequal arms (G. Shortley and R. Weller, Journal of Applied Physics 9, 1938), so that faces of A
and B lie where the level functions have them, not at nodes. They have the drift c_k lambda_k v_k. These drifts add up
to the drift F for c_k = v_k . D^-1 F.

These central differences are of second order, but beyond 1/p and -1/q for c_k a rate would be negative, and next to a
face V may change within a layer of the width 1 / (2 c_k), which is thinner than an arm. There the rates r forward and s
backward are fitted to the layer instead (A. Il'in, Mathematical Notes 6, 1969): they solve

    r p - s q = c_k lambda_k,   r (1 - e^(-2 c_k p)) = s (e^(2 c_k q) - 1),

so that they have the same drift, and with constant drift and noise the right probability of reaching the end of one arm
before that of the other. For large c_k they are upwind differences, of first order. Along an oblique v_k these would
add noise across the drift, and so c_k stays between -1/q and 1/p there. Offsets along axes take what these leave. What
is left of F along axes with little or no noise moves by the rate |R_i| / p for the rest R_i > 0, with p of the arm
along R_i.

Where drift or noise of a control has no number, a path with this control fails, as it does in the simulator.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import sparse

from pirl_rl.grid.mesh import Mesh, absorbed, finite
from pirl_rl.grid.stencil import bounded, decompose
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.structure import has_controlled_noise

LOOKS = 4
"""Number of points of an arm at which A and B are looked for; a set that passes between them is not seen."""

BISECTIONS = 12
"""The face is located to a fraction of 1 / (4 * 2^12) of an arm."""

STEEPEST = 20.0
"""The largest |c_k|, beyond which the drift moves along the axes. After one arm e^-40 is left of such a layer."""

LEAST_WEIGHT = 1e-12
"""The smallest lambda_k by which a drift is divided."""

SHORTEST = 1e-3
"""The smallest fraction of an arm; it bounds the rates, and moves a face by at most this share of a node distance."""

LOSSES = 1e9
"""The rate, in 1/horizon, at which paths fail where the physics has no numbers: at once beside every step."""


class Arm(NamedTuple):
    """Straight paths from M nodes along an offset.

    Attributes:
        fraction: how much of the offset is covered before A or B (M,), in (0, 1].
        node: the number of the node at its end (M,), among all nodes.
        cut: whether it ends in A or B (M,) bool.
        value: V where it is cut, else 0 (M,).
    """

    fraction: np.ndarray
    node: np.ndarray
    cut: np.ndarray
    value: np.ndarray


class Noise(NamedTuple):
    """The covariance of the noise per unit of time, in units of the mesh.

    Attributes:
        inverse: D^-1 (M, n, n), or (1, n, n) if it is the same at all nodes.
        directions: weight (M,) or (1,), offset (M, n) or (1, n), and the arms forward and backward, for each v_k.
    """

    inverse: np.ndarray
    directions: list[tuple[np.ndarray, np.ndarray, Arm, Arm]]


class Chain:
    """The chains of all candidates on the nodes outside A and B.

    Args:
        problem: the physics.
        mesh: the nodes.
        free: numbers (M,) of the nodes outside A and B.
        controls: candidate controls (K, M, m), in SI units.
        moves: whether the chains have the drift of the SDE. Without it they have the noise alone.

    Attributes:
        axes: forward and backward arms along each axis.
        shared: whether all candidates have the same chain: that of noise which does not depend on the control.
    """

    def __init__(
        self, problem: ReachAvoidProblem, mesh: Mesh, free: np.ndarray, controls: np.ndarray, moves: bool = True
    ):
        self._problem, self._mesh = problem, mesh
        self._at = mesh.indices()[free]
        self._unknown = np.full(mesh.size, -1)
        self._unknown[free] = np.arange(len(free))
        self.axes = [(self._arm(offset), self._arm(-offset)) for offset in np.eye(len(mesh.shape), dtype=int)]
        x = torch.from_numpy(mesh.states(self._at))
        controlled = has_controlled_noise(problem)
        self.shared = not (moves or controlled)
        noise, blocks, gains = None, [], []
        for u in controls[:1] if self.shared else controls:
            control = torch.from_numpy(np.array(u))
            drift, sigma = problem.drift(x, control), problem.diffusion(x, control)
            lost = ~sigma.isfinite().all(-1).all(-1) | (moves & ~drift.isfinite().all(-1))
            if noise is None or controlled:
                noise = self._noise(finite(sigma))
            rates, gain = self._assembled(finite(drift) * (moves / mesh.spacing), noise, lost.numpy())
            blocks.append(rates)
            gains.append(gain)
        self._rates: Any = sparse.vstack(blocks, format="csr")
        self._gains = np.concatenate(gains)

    def generator(self, value: np.ndarray) -> np.ndarray:
        """The generator of every candidate (K, M), or of the shared chain (1, M), in 1/s, of V (M,) at the nodes."""
        return (self._rates @ value + self._gains).reshape(-1, len(value))

    def of(self, policy: np.ndarray) -> tuple[sparse.csr_array, np.ndarray]:
        """The chain of a policy, given as the numbers (M,) of candidates.

        Returns:
            Rates (M, M) and gain (M,), both in 1/s: the generator of V is rates @ V + gain.
        """
        if self.shared:
            return self._rates, self._gains
        rows = policy * len(policy) + np.arange(len(policy))
        return self._rates[rows], self._gains[rows]

    def _arm(self, offsets: np.ndarray) -> Arm:
        """The arms from all nodes along offsets (M, n), or one offset (n,)."""
        problem, mesh = self._problem, self._mesh
        offsets = np.broadcast_to(offsets, self._at.shape)
        cut, fraction = np.zeros(len(offsets), bool), np.ones(len(offsets))
        for look in range(1, LOOKS + 1):
            now = ~cut & absorbed(problem, mesh.states(self._at + offsets * (look / LOOKS)))[0]
            fraction[now], cut = look / LOOKS, cut | now
        start, step, far = self._at[cut], offsets[cut], fraction[cut]
        near = far - 1 / LOOKS
        for _ in range(BISECTIONS):
            middle = (near + far) / 2
            inside = absorbed(problem, mesh.states(start + step * middle[:, None]))[0]
            near, far = np.where(inside, near, middle), np.where(inside, middle, far)
        value = np.zeros(len(offsets))
        value[cut] = absorbed(problem, mesh.states(start + step * far[:, None]))[1]
        fraction[cut] = np.maximum(far, SHORTEST)
        node = mesh.flat(self._at + offsets)
        # An arm that leaves the mesh ends on its edge, where the nearest node may lie in A or B.
        stopped = np.flatnonzero(~cut & (self._unknown[node] < 0))
        cut[stopped] = True
        value[stopped] = absorbed(problem, mesh.states(mesh.indices()[node[stopped]]))[1]
        return Arm(fraction, node, cut, value)

    def _noise(self, sigma: np.ndarray) -> Noise:
        """The noise of sigma (M, n, w)."""
        scaled = sigma / self._mesh.spacing[:, None]
        covariance = scaled @ scaled.swapaxes(-2, -1)
        constant = bool((covariance == covariance[:1]).all())
        covariance = bounded(covariance[:1] if constant else covariance, 1 / max(self._mesh.shape))
        weights, offsets = decompose(covariance)
        # An axis without noise has no inverse; with this small addition its c_k are beyond every limit.
        trace = np.trace(covariance, axis1=-2, axis2=-1)[:, None, None]
        inverse = np.linalg.inv(covariance + (1e-9 * trace + 1e-30) * np.eye(covariance.shape[-1]))
        directions = []
        for weight, offset in zip(weights.T, offsets.swapaxes(0, 1), strict=True):
            if weight.any():
                directions.append((weight, offset, self._arm(offset), self._arm(-offset)))
        return Noise(inverse, directions)

    def _assembled(self, drift: np.ndarray, noise: Noise, lost: np.ndarray) -> tuple[sparse.csr_array, np.ndarray]:
        """The rates (M, M) and the gain (M,) of one candidate with its drift (M, n), in units of the mesh per s.

        Paths from the nodes that are `lost` (M,) bool fail.
        """
        jumps, rest = [], drift.copy()
        slope = np.einsum("pij,pj->pi", np.broadcast_to(noise.inverse, (len(drift), *noise.inverse.shape[1:])), drift)
        # Axes come last, and take what oblique offsets have left.
        for along_axes in (False, True):
            for weight, offset, forward, backward in noise.directions:
                p, q = forward.fraction, backward.fraction
                here = ((offset != 0).sum(-1) == 1) == along_axes
                if not here.any():
                    continue
                if along_axes:
                    share = (offset * rest).sum(-1) / np.maximum(weight, LEAST_WEIGHT)
                else:
                    share = (offset * slope).sum(-1).clip(-1 / q, 1 / p)
                share = share.clip(-STEEPEST, STEEPEST)
                fitted = forward.cut | backward.cut | (share > 1 / p) | (share < -1 / q)
                ahead, back = _jump_rates(share, p, q, fitted)
                rate = weight * here
                jumps += [(forward, rate * ahead), (backward, rate * back)]
                rest -= (share * rate)[:, None] * offset
        for axis, (forward, backward) in enumerate(self.axes):
            jumps.append((forward, rest[:, axis].clip(0) / forward.fraction))
            jumps.append((backward, (-rest[:, axis]).clip(0) / backward.fraction))
        size = len(drift)
        gain, out = np.zeros(size), lost * (LOSSES / self._problem.horizon)
        rows, columns, rates = [], [], []
        for arm, rate in jumps:
            gain += rate * arm.value
            out += rate
            inner = ~arm.cut & (rate > 0)
            rows.append(np.flatnonzero(inner))
            columns.append(self._unknown[arm.node[inner]])
            rates.append(rate[inner])
        rows.append(np.arange(size))
        columns.append(np.arange(size))
        rates.append(-out)
        entries = np.concatenate(rates), (np.concatenate(rows), np.concatenate(columns))
        return sparse.coo_array(entries, shape=(size, size)).tocsr(), gain


def _jump_rates(c: np.ndarray, p: np.ndarray, q: np.ndarray, fitted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rates forward and backward, each (M,), for lambda = 1: central, or `fitted` (M,) bool to a layer."""
    ahead, back = (1 + c * q) / (p * (p + q)), (1 - c * p) / (q * (p + q))
    # The two agree up to a share of c^2, and the formula below is lost in rounding where c is nearly 0.
    layer = fitted & (np.abs(c) > 1e-4)
    c, p, q = c[layer], p[layer], q[layer]
    forward, backward = np.expm1(2 * c * q), -np.expm1(-2 * c * p)
    scale = c / (p * forward - q * backward)
    ahead[layer], back[layer] = scale * forward, scale * backward
    return ahead, back
