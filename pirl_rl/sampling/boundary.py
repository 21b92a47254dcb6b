"""Points of the parabolic boundary, tau = 0 and the faces of A and B, with the value V of Eq. (parabolic_boundary).

The number of points of a sample is fixed, so that an update has static shapes.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.faces import find_faces
from pirl_rl.sampling.initial_states import sample_interior


class BoundarySampler:
    """Samples points at tau = 0, and on the faces of A and B at tau in (0, T], with the value V there.

    The points on the faces are drawn from a pool, see `pirl_rl.sampling.faces`.

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
        ProblemError: a set of the problem is not found.
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
        rng = torch.Generator().manual_seed(seed)
        self._pool = find_faces(problem, rng)

    def sample(self, rng: torch.Generator, replay: TensorDictBase | None = None) -> TensorDict:
        """Draw N = initial + faces points.

        Args:
            rng: the random generator, on whose device the points are.
            replay: transitions, whose "state" (k, n) are the visited states.

        Returns:
            A TensorDict with "tau" (N, 1), in s, "state" (N, n) and "value" (N,).
        """
        device, dtype = rng.device, torch.get_default_dtype()
        state = sample_interior(self.problem, self.box, self.initial, rng, dtype)
        visited = 0 if replay is None else round(self.replay_share * self.initial)
        if replay is not None and visited:
            index = torch.randint(len(replay), (visited,), generator=rng, device=device)
            state = torch.cat([replay["state"][index], state[visited:]])
        value, tau = self.problem.boundary_value(state), torch.zeros(self.initial, 1, device=device)
        if self.faces:
            points, values = self._pool.points.to(device), self._pool.values.to(device)
            index = torch.randint(len(points), (self.faces,), generator=rng, device=device)
            late = 1 - torch.rand(self.faces, 1, generator=rng, device=device)
            tau = torch.cat([tau, self.problem.horizon * late**self.tau_power])
            state, value = torch.cat([state, points[index]]), torch.cat([value, values[index]])
        return TensorDict({"tau": tau, "state": state, "value": value}, batch_size=[len(tau)])
