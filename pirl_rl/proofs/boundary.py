"""Where W is given as it is fitted: on the faces of A and B, and on the sides of the mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from scipy.spatial import KDTree

from pirl_rl.proofs.ends import NEAR, Ends
from pirl_rl.proofs.faces import downward, face_points, sides, smooth_avoid, smooth_target
from pirl_rl.proofs.mesh import GAUSS, Mesh
from pirl_rl.proofs.points import Points
from pirl_rl.proofs.rates import Policy, controls_at
from pirl_rl.proofs.spline import design

LOSS = 0.006
"""What W loses over the horizon to the least source, LOSS / T in 1/s."""

RAMP = 0.1
"""The share of the horizon in which W rises at a face above its value at tau = 0, without which it would jump there."""

RESOLVED = 1.0
"""The width in cells of a layer, in which noise works against the drift, that the mesh resolves."""

APART = 4.0
"""W = 1 is given on a face at this number of cells from parts of it that paths cannot cross, and less between."""


class Boundary:
    """The values of W on the parabolic boundary.

    Where W may be 1 on a face, it need not be. It is not given in a layer that the mesh does not resolve, and it rises
    gradually from parts of the face that paths cannot cross, at which it would jump.

    Args:
        ends: the problem, and what W may be where paths end.
        policy: the control.
        mesh: the mesh.
        x: states (P, n) of the mesh.

    Attributes:
        target: the level of A, or of the set without corners in its place; None without A.
    """

    def __init__(self, ends: Ends, policy: Policy, mesh: Mesh, x: np.ndarray):
        self.ends, self.policy, self.mesh, states = ends, policy, mesh, torch.from_numpy(x)
        self.target = smooth_target(ends, states) if ends.has_target else None
        self._avoid = smooth_avoid(ends, mesh, states) if ends.problem.has_avoid_set else None
        none = np.zeros((0, x.shape[1]))
        self._reached = design(mesh.space, none if self.target is None else face_points(self.target, mesh, x))
        left = outward = none
        if self._avoid is not None:
            left, reach = face_points(self._avoid, mesh, x), NEAR * (mesh.high - mesh.low)
            # The others are those of the sides.
            left = left[((left > mesh.low + reach) & (left < mesh.high - reach)).all(-1)]
            outward = downward(self._avoid, left)
        side, out = sides(ends, mesh, GAUSS)
        self._outward = np.concatenate([outward, out])
        self._exits = Points(ends.problem, mesh, np.concatenate([left, side]))
        in_avoid = ends.in_avoid(torch.from_numpy(self._exits.x)).numpy()
        self._in_avoid = in_avoid | (np.arange(len(in_avoid)) < len(left))
        one = self._in_avoid & (ends.at_avoid == 1)
        cells = np.abs(self._outward * mesh.widths_at(self._exits.x)).sum(-1)
        self._layers = np.where(one, RESOLVED * cells, 0.0)

    def given(self, x: np.ndarray) -> np.ndarray:
        """Whether states (N, n) are in A or in B, or in the sets without corners in their place."""
        states, ended = torch.from_numpy(x), np.zeros(len(x), bool)
        for level in (self.target, self._avoid):
            if level is not None:
                ended |= (level(states) <= 0).numpy()
        return ended

    def at(self, tau: float) -> tuple[Any, np.ndarray]:
        """The sparse matrix (K, N) of W where it is given at a time to go, and its values (K,)."""
        factors = self._exits.factors(controls_at(self.policy, tau, self._exits))
        crossed = self._exits.crossed(factors, self._outward, self._layers)
        shut = ~self._exits.crossed(factors, self._outward, np.zeros(len(crossed)))
        left = np.where(self._in_avoid, self._on_face(self.ends.at_avoid, tau), 0.0) * self._shares(shut)
        reached = np.full(self._reached.shape[0], self._on_face(self.ends.at_target, tau))
        return sp.vstack([self._reached, self._exits.values[crossed]]), np.concatenate([reached, left[crossed]])

    def _on_face(self, value: float, tau: float) -> float:
        """W at a time to go on a face at which it may have a value: it rises to it from the value at tau = 0.

        Where W bounds failures, it then falls by its loss to the source, as it does next to the face. Where it has no
        slope, L^pi W is the rate of this fall.
        """
        start, share = min(self.ends.at_start, value), tau / self.ends.problem.horizon
        loss = LOSS * share if value > 0 and not self.ends.success else 0.0
        return start + (value - start) * float(smoothstep(share / RAMP)) - loss

    def _shares(self, shut: np.ndarray) -> np.ndarray:
        """The shares (P,) of the values at exits, which rise with the distance from those that are shut (P,)."""
        if not shut.any():
            return np.ones(len(shut))
        places = self.mesh.places_of(self._exits.x)
        distance, _ = KDTree(places[shut]).query(places)
        return smoothstep(distance / APART)


def smoothstep(share: np.ndarray | float) -> np.ndarray:
    """The polynomial that rises from 0 at 0 to 1 at 1 with two vanishing derivatives at both."""
    z = np.clip(share, 0, 1)
    return z**3 * (10 - 15 * z + 6 * z**2)
