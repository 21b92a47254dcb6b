"""The Markov chain of each candidate control: its jump rates between nodes and into A and B.

Along an offset v of the mesh let p and q in (0, 1] be the fractions of v and of -v that a straight path covers before
it enters A or B; they are 1 where it does not. With D = sum_k lambda_k v_k v_k^T the rates forward and backward are

    lambda / (p (p + q)),   lambda / (q (p + q)),

the second difference with unequal arms of G. Shortley and R. Weller (Journal of Applied Physics 9, 1938): faces of A and
B lie where the level functions have them, not at nodes. Along an axis with the drift F, in units of the mesh, they are

    (a + F q) / (p (p + q)),   (a - F p) / (q (p + q))   with   a = max(lambda, F p, -F q).

These are central differences where the noise is strong enough, and else upwind differences: a - lambda is the least
artificial noise with rates >= 0. Both have the drift F exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse

from pirl_rl.grid.mesh import Mesh, absorbed
from pirl_rl.grid.stencil import decompose
from pirl_rl.problem import ReachAvoidProblem, has_controlled_noise

LOOKS = 4
"""Number of points of an arm at which A and B are looked for; a set that passes between them is not seen."""

BISECTIONS = 12
"""The face is located to a fraction of 1 / (4 * 2^12) of an arm."""

SHORTEST = 1e-3
"""The smallest fraction of an arm; it bounds the rates, and moves a face by at most this share of a node distance."""


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


class Chain:
    """The chains of all candidates on the nodes outside A and B.

    Args:
        problem: the physics.
        mesh: the nodes.
        free: numbers (M,) of the nodes outside A and B.
        controls: candidate controls (K, M, m), in SI units.

    Attributes:
        axes: forward and backward arms along each axis.
    """

    def __init__(self, problem: ReachAvoidProblem, mesh: Mesh, free: np.ndarray, controls: np.ndarray):
        self._problem, self._mesh = problem, mesh
        self._at = mesh.indices()[free]
        self._unknown = np.full(mesh.size, -1)
        self._unknown[free] = np.arange(len(free))
        self.axes = [(self._arm(offset), self._arm(-offset)) for offset in np.eye(len(mesh.shape), dtype=int)]
        x = torch.from_numpy(mesh.states(self._at))
        noise, blocks, gains = None, [], []
        for u in controls:
            control = torch.from_numpy(np.ascontiguousarray(u))
            drift = problem.drift(x, control).numpy() / mesh.spacing
            if noise is None or has_controlled_noise(problem):
                noise = self._noise(problem.diffusion(x, control).numpy())
            rates, gain = self._assembled(drift, *noise)
            blocks.append(rates)
            gains.append(gain)
        self._rates: sparse.csr_array = sparse.vstack(blocks, format="csr")
        self._gains = np.concatenate(gains)

    def generator(self, value: np.ndarray) -> np.ndarray:
        """The generator of every candidate (K, M), in 1/s, of V (M,) at the nodes."""
        return (self._rates @ value + self._gains).reshape(-1, len(value))

    def of(self, policy: np.ndarray) -> tuple[sparse.csr_array, np.ndarray]:
        """The chain of a policy, given as the numbers (M,) of candidates.

        Returns:
            Rates (M, M) and gain (M,), both in 1/s: the generator of V is rates @ V + gain.
        """
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
        return Arm(fraction, mesh.flat(self._at + offsets), cut, value)

    def _noise(self, sigma: np.ndarray) -> tuple[np.ndarray, list[tuple[np.ndarray, Arm, Arm]]]:
        """The noise along the axes (M, n), and the weights (M,) and arms of the oblique offsets."""
        scaled = sigma / self._mesh.spacing[:, None]
        covariance = scaled @ scaled.swapaxes(-2, -1)
        constant = (covariance == covariance[:1]).all()
        weights, offsets = decompose(covariance[:1] if constant else covariance, 1 / max(self._mesh.shape))
        if constant:
            weights, offsets = (np.repeat(entry, len(covariance), 0) for entry in (weights, offsets))
        along = np.zeros_like(covariance[..., 0])
        oblique = []
        for weight, offset in zip(weights.T, offsets.swapaxes(0, 1), strict=True):
            straight = np.abs(offset).sum(-1) == 1
            along += np.abs(offset) * (weight * straight)[:, None]
            rest = np.where(straight, 0.0, weight)
            if rest.any():
                oblique.append((rest, self._arm(offset), self._arm(-offset)))
        return along, oblique

    def _assembled(self, drift: np.ndarray, along: np.ndarray, oblique) -> tuple[sparse.csr_array, np.ndarray]:
        """The rates (M, M) and the gain (M,) of one candidate with its drift (M, n), in units of the mesh per s."""
        jumps = []
        for axis, (forward, backward) in enumerate(self.axes):
            p, q, speed = forward.fraction, backward.fraction, drift[:, axis]
            noise = np.maximum(along[:, axis], np.maximum(speed * p, -speed * q))
            jumps += [(forward, (noise + speed * q) / (p * (p + q))), (backward, (noise - speed * p) / (q * (p + q)))]
        for weight, forward, backward in oblique:
            p, q = forward.fraction, backward.fraction
            jumps += [(forward, weight / (p * (p + q))), (backward, weight / (q * (p + q)))]
        size = len(drift)
        gain, out = np.zeros(size), np.zeros(size)
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
