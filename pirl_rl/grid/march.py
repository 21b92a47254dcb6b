"""The steps in tau: implicit Euler steps, each solved by policy iteration (R. Howard 1960).

A step from V' to V solves V - dt max_u {rates(u) V + gain(u)} = V', and an error r of this equation is an error of at
most |r| in V, because the scheme is monotone. The steps are equidistant in sqrt(tau), since V changes fastest where
tau is small.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, bicgstab, spsolve

from pirl_rl.grid.chain import Chain
from pirl_rl.grid.mesh import Mesh
from pirl_rl.grid.transport import Transport

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


class March:
    """The steps from V at tau = 0 to the horizon, on the M nodes outside A and B.

    Args:
        chain: the chains of all candidates.
        continued: gives V (N,) at all nodes from V (M,).
        horizon: in s.
        steps: the number of steps.
    """

    def __init__(self, chain: Chain, continued: Callable[[np.ndarray], np.ndarray], horizon: float, steps: int):
        self._chain, self._continued, self._horizon, self._steps = chain, continued, horizon, steps
        self._shares = np.linspace(0, 1, steps + 1) ** 2

    def together(self, value: np.ndarray) -> Iterator[Level]:
        """Steps in which drift and noise act at once, from V (M,) at tau = 0: equal ones in sqrt(tau)."""
        policy = np.zeros(len(value), int)
        for level, share in enumerate(np.diff(self._shares), start=1):
            value, policy = self._advance(value, policy, self._horizon * share)
            yield level, self._continued(value), policy

    def in_turns(self, value: np.ndarray, transport: Transport, first: int) -> Iterator[Level]:
        """Steps in which drift and noise act in turns, from V (M,) at tau = 0.

        The noise acts for half a step before the drift and for half a step after it. Where the control stays the same,
        the error of taking turns is then of second order in the length of a step (G. Strang, SIAM Journal on Numerical
        Analysis 5, 1968); that of the implicit Euler steps of the noise is of first order. The lengths of the steps are
        equal, so that their paths are the same. V is noted at the times of all solutions. In the `first` steps V is
        that of a control that is held, where the noise acts on the faces.
        """
        noisy, dt, times = transport.noise_acts_on_faces(), self._horizon / self._steps, self._steps * self._shares
        after, policy = self._continued(value), np.zeros(len(value), int)
        for step in range(self._steps):
            before, half = after, self._solve(value, value, policy, dt / 2)
            policy, moved = self._turn(transport, self._continued(half), policy, dt)
            value = self._solve(moved, moved, policy, dt / 2)
            if step < first:
                held, best = transport.first(step + 1)
                value, policy = np.where(noisy, held, value), np.where(noisy, best, policy)
            after = self._continued(value)
            within = times - step
            for level in np.flatnonzero((within > 0) & (within <= 1)):
                yield int(level), (1 - within[level]) * before + within[level] * after, policy

    def _turn(
        self, transport: Transport, field: np.ndarray, policy: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The best policy (M,) of a step in turns from V (N,) at all nodes, and V (M,) at the ends of its paths.

        Where candidates are equally good a node keeps the one of `policy` (M,), with which V rose there. V is that of
        the best candidate or of the one that the node had, where that is larger and the noise is the same.
        """
        seen, nodes = transport.seen(field), np.arange(len(policy))
        if self._chain.shared:
            best = seen.argmax(0)
            value = transport.moved(field, best, policy).max(0)
            return np.where(seen[best, nodes] > seen[policy, nodes] + GAIN, best, policy), value
        value = seen[policy, nodes]
        for turn in range(TURNS):
            if turn:
                value = self._solve(seen[policy, nodes], value, policy, dt)
            scores = seen + dt * self._chain.generator(value)
            best = scores.argmax(0)
            policy = np.where(scores[best, nodes] > scores[policy, nodes] + GAIN, best, policy)
        return policy, transport.moved(field, policy)[0]

    def _advance(self, before: np.ndarray, policy: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """V (M,) and the policy (M,) one step after `before` (M,), by policy iteration from `policy` (M,)."""
        value, nodes = before, np.arange(len(before))
        for iteration in range(ITERATIONS):
            rates = self._chain.generator(value)
            better = rates.argmax(0)
            gained = rates[better, nodes] - rates[policy, nodes]
            if iteration and dt * gained.max() <= TOLERANCE:
                break
            # A candidate that is only as good as the present one does not replace it: the iteration cannot alternate.
            policy = np.where(dt * gained > TOLERANCE / 10, better, policy)
            value = self._solve(before, value, policy, dt)
        return value, policy

    def _solve(self, before: np.ndarray, guess: np.ndarray, policy: np.ndarray, dt: float) -> np.ndarray:
        """V (M,) of a policy (M,) after one implicit step from `before` (M,).

        The iteration, of stabilised bi-conjugate gradients, may break down, mostly where its result is exact already.
        Where it is not, elimination takes its place. With three axes this would take gigabytes and minutes. There two
        steps of half the length take the place of the step, since their equations are nearer to V = V'.
        """
        rates, gain = self._chain.of(policy)
        matrix = sparse.eye_array(len(before), format="csr") - dt * rates
        right, diagonal = before + dt * gain, matrix.diagonal()
        scaling = LinearOperator(matrix.shape, matvec=lambda residual: residual / diagonal)  # type: ignore[call-arg]
        value, failed = bicgstab(matrix, right, guess, rtol=0.0, atol=TOLERANCE, maxiter=1000, M=scaling)
        if not failed or np.abs(matrix @ value - right).max() <= TOLERANCE:
            return value
        if len(self._chain.axes) < 3:
            return np.asarray(spsolve(matrix.tocsc(), right))
        middle = self._solve(before, before, policy, dt / 2)
        return self._solve(middle, middle, policy, dt / 2)


class Continuation:
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
