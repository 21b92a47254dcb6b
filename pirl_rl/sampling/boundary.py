"""Points of the parabolic boundary, tau = 0 and the faces of A and B, with the value V of Eq. (parabolic_boundary).

The number of points of a sample is fixed, so that an update has static shapes.

At a face that paths cross under the best control, V has the value of the set. Where the best control leads away from
the set with speed v > 0, V has that value in the limit only because noise of size s across the face brings some paths
back: the one-dimensional equation v V' + s^2/2 V'' = 0 has solutions in exp(-2 v d / s^2) of the distance d. Data on a
face whose layer s^2 / (2 v) is thinner than a network resolves would pull V down, or up, far into the interior.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from pirl_rl import recording
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.faces import FACE_POOL, Faces, find_faces
from pirl_rl.sampling.initial_states import sample_interior
from pirl_rl.switching import control_levels

RESOLVED = 0.05
"""The width of the thinnest layer at a face in which data have their full weight, in half widths of the box."""

AT_ONCE = 1_024
"""The number of points whose weights are computed at once, which bounds the memory with many states."""


class BoundarySampler:
    """Samples points at tau = 0, and on the faces of A and B at tau in (0, T], with the value V there.

    The points on the faces are drawn from a pool, see `pirl_rl.sampling.faces`, and weighted, see `face_weights`. Where
    the problem itself gives the points, `ReachAvoidProblem.faces`, all weights are 1.

    Args:
        problem: gives the sets and the boundary values.
        initial: the number of points at tau = 0 in a sample; they are uniform outside A and B.
        faces: the number of points on the faces in a sample.
        widen: the points at tau = 0 lie in the box `states`, widened by this factor.
        tau_power: on the faces, tau = T U^tau_power with U uniform, as in `Collocation`.
        replay_share: the share of the points at tau = 0 that are replaced by visited states.
        seed: the seed of the pool.

    Raises:
        ArgumentError: a number is out of range.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        initial: int = 100,
        faces: int = 100,
        widen: float = 1.0,
        tau_power: float = 2.0,
        replay_share: float = 0.0,
        seed: int = 0,
    ):
        if initial < 0 or faces < 0 or initial + faces < 1:
            raise ArgumentError(
                f"boundary: expected initial, faces >= 0 and one of them > 0, got {initial} and {faces}"
            )
        if not widen > 0 or not tau_power > 0:
            raise ArgumentError(f"boundary: expected widen > 0 and tau_power > 0, got {widen} and {tau_power}")
        self.problem, self.initial, self.faces, self.tau_power = problem, initial, faces, tau_power
        if not 0 <= replay_share <= 1:
            raise ArgumentError(f"boundary.replay_share: expected 0 <= replay_share <= 1, got {replay_share}")
        self.replay_share, self.box = replay_share, problem.states.expand(widen)
        self.seed = seed

    @cached_property
    def _pool(self) -> Faces:
        """The points on the faces, which are not searched where the boundary has no weight in the loss."""
        return find_faces(self.problem, torch.Generator().manual_seed(self.seed))

    @cached_property
    def _weights(self) -> Tensor:
        """The weights of the pool."""
        points, values = self._pool.points, self._pool.values
        if self.problem.faces(1, torch.Generator()) is not None:
            return torch.ones_like(values)
        return face_weights(self.problem, points, values)

    @cached_property
    def _kept(self) -> dict[tuple[str, torch.device], Any]:
        """What stays on a device, since each copy to it takes time."""
        return {}

    def _faces_on(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """The points of the pool (K, n), with their values and weights (K,), on a device."""
        if ("faces", device) not in self._kept:
            entries = self._pool.points, self._pool.values, self._weights
            self._kept["faces", device] = tuple(entry.to(device) for entry in entries)
        return self._kept["faces", device]

    def _interior(self, rng: torch.Generator) -> Tensor:
        """States (initial, n), uniform in the part of the box outside A and B.

        On a GPU they come from a pool that is drawn once: to draw again what lies in A or B asks the device for it.
        """
        draw = partial(sample_interior, self.problem, self.box, rng=rng, dtype=torch.get_default_dtype())
        if not recording.records(rng.device):
            return draw(self.initial)
        if ("interior", rng.device) not in self._kept:
            self._kept["interior", rng.device] = draw(FACE_POOL)
        pool = self._kept["interior", rng.device]
        return pool[torch.randint(len(pool), (self.initial,), generator=rng, device=rng.device)]

    def sample(self, rng: torch.Generator, replay: TensorDictBase | None = None) -> TensorDict:
        """Draw N = initial + faces points.

        Args:
            rng: the random generator, on whose device the points are.
            replay: transitions, whose "state" (k, n) are the visited states.

        Returns:
            A TensorDict with "tau" (N, 1), in s, "state" (N, n), "value" (N,) and "weight" (N,).

        Raises:
            ProblemError: a set of the problem is not found.
        """
        device = rng.device
        state = self._interior(rng)
        visited = 0 if replay is None else round(self.replay_share * self.initial)
        if replay is not None and visited:
            index = torch.randint(len(replay), (visited,), generator=rng, device=device)
            state = torch.cat([replay["state"][index], state[visited:]])
        value, tau = self.problem.boundary_value(state), torch.zeros(self.initial, 1, device=device)
        weight = torch.ones_like(value)
        if self.faces:
            points, values, weights = self._faces_on(device)
            index = torch.randint(len(points), (self.faces,), generator=rng, device=device)
            late = 1 - torch.rand(self.faces, 1, generator=rng, device=device)
            tau = torch.cat([tau, self.problem.horizon * late**self.tau_power])
            state, value = torch.cat([state, points[index]]), torch.cat([value, values[index]])
            weight = torch.cat([weight, weights[index]])
        return TensorDict({"tau": tau, "state": state, "value": value, "weight": weight}, batch_size=[len(tau)])


def face_weights(problem: ReachAvoidProblem, points: Tensor, values: Tensor) -> Tensor:
    """Weights (K,) in [0, 1] of boundary data: the width of the layer at the face in units of `RESOLVED`, at most 1.

    Speeds and widths are those along the normal of the face in coordinates in which the box of states is [-1, 1]^n. The
    best control moves away from B, and towards A. One coordinate of it after the other is taken from its levels, see
    `pirl_rl.switching.control_levels`. These are its two bounds, which is exact, where the Hamiltonian is affine in u.

    Args:
        problem: the physics and the sets.
        points: points (K, n) of the faces.
        values: V (K,) there, 1 on the faces of A and 0 on those of B.
    """
    levels = control_levels(problem)
    parts = zip(points.split(AT_ONCE), values.split(AT_ONCE), strict=True)
    return torch.cat([_weights_of_part(problem, *part, levels) for part in parts])


def _weights_of_part(problem: ReachAvoidProblem, points: Tensor, values: Tensor, count: int) -> Tensor:
    """`face_weights` (K,) of a few points, where each coordinate of the control has so many levels."""
    _, half_width = problem.states.center_and_half_width(points)
    normal = torch.nn.functional.normalize(_outward(problem, points, values) * half_width, dim=-1)
    on_target = values > 0.5

    def speed(u: Tensor) -> Tensor:
        return (problem.drift(points, u) / half_width * normal).sum(-1)

    u = problem.controls.denormalize(points.new_zeros(len(points), problem.controls.dim))
    for axis, (low, high) in enumerate(zip(problem.controls.low, problem.controls.high, strict=True)):
        levels = torch.linspace(low, high, count, dtype=torch.float64).tolist()
        u, *others = (u.index_fill(-1, torch.tensor(axis), level) for level in levels)
        for other in others:
            preferred = (speed(other) > speed(u)) != on_target
            u = torch.where(preferred.unsqueeze(-1), other, u)
    across = (problem.diffusion(points, u) / half_width.unsqueeze(-1) * normal.unsqueeze(-1)).sum(-2)
    away = speed(u)
    layer = across.square().sum(-1) / (2 * away)
    return torch.where(away > 0, layer / RESOLVED, 1.0).clamp(max=1)


def _outward(problem: ReachAvoidProblem, points: Tensor, values: Tensor) -> Tensor:
    """The gradient (K, n) of the level of the set on whose face a point lies."""
    x = points.detach().requires_grad_()
    with torch.enable_grad():
        level = problem.scaled_avoid_constraints(x).amin(-1)
        if problem.objective == "reach-avoid":
            level = torch.where(values > 0.5, problem.scaled_reached_level(x), level)
        return torch.autograd.grad(level.sum(), x)[0]
