"""Where the physics is imposed: interior points for the HJB residual, and the parabolic boundary.

Both samplers return TensorDicts of fixed size, so that an update keeps static shapes; interior points that fall inside
A or B, or have tau outside (0, T], are masked, not dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from pirl_rl.initial_states import sample_interior
from pirl_rl.problem import ProblemError, ReachAvoidProblem

FACE_POOL = 16_384
BISECTIONS = 50


class Collocation:
    """Points (tau, x) of the box (0, T] x states.

    Args:
        problem: gives the box and the mask.
        size: points a draw.
        sampler: "uniform", or "sobol" for scrambled low-discrepancy points.
        widen: the box's widths are multiplied by this, so that points reach beyond it.
        tau_power: tau = T U^tau_power; 1 is uniform, 2 puts more points near tau = 0, where V is steep.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        size: int = 1_000,
        sampler: Literal["uniform", "sobol"] = "uniform",
        widen: float = 1.0,
        tau_power: float = 1.0,
    ):
        if sampler not in ("uniform", "sobol"):
            raise ValueError(f"collocation.sampler: expected 'uniform' or 'sobol', got {sampler!r}")
        if size < 1 or not widen > 0 or not tau_power > 0:
            raise ValueError(
                f"collocation: expected size >= 1, widen > 0, tau_power > 0, got {size}, {widen}, {tau_power}"
            )
        self.problem, self.size, self.sampler, self.tau_power = problem, size, sampler, tau_power
        self.box = problem.states.expand(widen)

    def sample(
        self, generator: torch.Generator, replay: TensorDictBase | None = None, progress: float = 0.0
    ) -> TensorDict:
        """{"tau" (size, 1), "state" (size, n), "mask" (size,)}.

        Args:
            replay: transitions of the update, for samplers that stay near visited states.
            progress: of the loss schedule, for samplers that move with it.
        """
        unit = self._unit(generator)
        # 1 - U lies in (0, 1]: tau = 0 belongs to the boundary.
        tau = self.problem.horizon * (1 - unit[:, :1]) ** self.tau_power
        state = self.box.denormalize(2 * unit[:, 1:] - 1)
        return TensorDict({"tau": tau, "state": state, "mask": self.mask(tau, state)}, batch_size=[self.size])

    def mask(self, tau: Tensor, state: Tensor) -> Tensor:
        """(N,) bool: points where the HJB equation holds."""
        t = tau.squeeze(-1)
        known = ~self.problem.interior(state) | self.problem.unreachable(state)
        return ~known & (t > 0) & (t <= self.problem.horizon)

    def _unit(self, generator: torch.Generator) -> Tensor:
        dim = 1 + self.box.dim
        if self.sampler == "uniform":
            return torch.rand(self.size, dim, generator=generator, device=generator.device)
        seed = int(torch.randint(2**31, (), generator=generator, device=generator.device))
        engine = torch.quasirandom.SobolEngine(dim, scramble=True, seed=seed)
        return engine.draw(self.size).to(generator.device)


class ReplayCollocation(Collocation):
    """Points near those that the policy visits, in the dimensions where a box is mostly empty, and a rest as above.

    A visited (tau, x) is moved by independent normal steps in the coordinates in which (0, T] x states is a cube of
    width 2. Both the share of such points and the deviation of the steps move with the loss schedule, as in the
    transition and the refinement stages of the paper.

    Args:
        problem, size, sampler, widen, tau_power: as of `Collocation`, for the rest.
        replay_share: share of points near visited ones, at the schedule's start and end.
        jitter: deviation of the steps, at the schedule's start and end.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        size: int = 1_000,
        sampler: Literal["uniform", "sobol"] = "uniform",
        widen: float = 1.0,
        tau_power: float = 1.0,
        replay_share: Sequence[float] = (1.0, 1.0),
        jitter: Sequence[float] = (0.0, 0.0),
    ):
        super().__init__(problem, size, sampler, widen, tau_power)
        for name, ends, most in (("replay_share", replay_share, 1.0), ("jitter", jitter, float("inf"))):
            if len(ends) != 2 or not all(0 <= end <= most for end in ends):
                raise ValueError(f"collocation.{name}: expected [start, end] from 0 to {most:g}, got {list(ends)}")
        self.replay_share, self.jitter = tuple(replay_share), tuple(jitter)

    def sample(
        self, generator: torch.Generator, replay: TensorDictBase | None = None, progress: float = 0.0
    ) -> TensorDict:
        rest = super().sample(generator, replay, progress)
        if replay is None:
            return rest
        share, jitter = (start + (end - start) * progress for start, end in (self.replay_share, self.jitter))
        device, horizon = generator.device, self.problem.horizon
        index = torch.randint(len(replay), (self.size,), generator=generator, device=device)
        step = jitter * torch.randn(self.size, 1 + self.problem.states.dim, generator=generator, device=device)
        # Reflected at both ends of (0, T]: a negative tau has no root, and NaN at a masked point spoils all gradients.
        tau = torch.abs(replay["tau"][index] + step[:, :1] * horizon / 2)
        tau = horizon - torch.abs(horizon - tau)
        state = self.problem.states.denormalize(self.problem.states.normalize(replay["state"][index]) + step[:, 1:])
        taken = torch.rand(self.size, 1, generator=generator, device=device) < share
        tau, state = torch.where(taken, tau, rest["tau"]), torch.where(taken, state, rest["state"])
        return TensorDict({"tau": tau, "state": state, "mask": self.mask(tau, state)}, batch_size=[self.size])


class BoundarySampler:
    """Points of the parabolic boundary with the value V there: tau = 0, and the faces of A and B at tau in (0, T].

    Faces come from `problem.faces` where it is given; else from a pool found once by bisection of the level functions
    between points inside and outside, over a box twice as wide as `states`.

    Args:
        problem: gives sets and values.
        initial: points a draw at tau = 0, uniform in `states` outside A and B.
        faces: points a draw on the faces.
        widen: the box of the points at tau = 0 is wider than `states` by this factor.
        tau_power: tau = T U^tau_power on the faces, as in `Collocation`.
        replay_share: share of the points at tau = 0 that are visited states instead.
        seed: of the pool.

    Raises:
        ProblemError: faces that sampling does not find.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        initial: int = 100,
        faces: int = 100,
        widen: float = 1.0,
        tau_power: float = 1.0,
        replay_share: float = 0.0,
        seed: int = 0,
    ):
        if initial < 0 or faces < 0 or initial + faces < 1:
            raise ValueError(f"boundary: expected initial, faces >= 0 and one of them > 0, got {initial} and {faces}")
        if not widen > 0 or not tau_power > 0:
            raise ValueError(f"boundary: expected widen > 0 and tau_power > 0, got {widen} and {tau_power}")
        self.problem, self.initial, self.faces, self.tau_power = problem, initial, faces, tau_power
        if not 0 <= replay_share <= 1:
            raise ValueError(f"boundary.replay_share: expected 0 <= replay_share <= 1, got {replay_share}")
        self.replay_share, self.box = replay_share, problem.states.expand(widen)
        generator = torch.Generator().manual_seed(seed)
        self._pool = _face_pool(problem, generator)

    def sample(self, generator: torch.Generator, replay: TensorDictBase | None = None) -> TensorDict:
        """{"tau" (N, 1), "state" (N, n), "value" (N,)} with N = initial + faces; `replay` holds the visited states."""
        device, dtype = generator.device, torch.get_default_dtype()
        state = sample_interior(self.problem, self.box, self.initial, generator, dtype)
        visited = 0 if replay is None else round(self.replay_share * self.initial)
        if replay is not None and visited:
            index = torch.randint(len(replay), (visited,), generator=generator, device=device)
            state = torch.cat([replay["state"][index], state[visited:]])
        value, tau = self.problem.boundary_value(state), torch.zeros(self.initial, 1, device=device)
        if self.faces:
            points, values = (entry.to(device) for entry in self._pool)
            index = torch.randint(len(points), (self.faces,), generator=generator, device=device)
            late = 1 - torch.rand(self.faces, 1, generator=generator, device=device)
            tau = torch.cat([tau, self.problem.horizon * late**self.tau_power])
            state, value = torch.cat([state, points[index]]), torch.cat([value, values[index]])
        return TensorDict({"tau": tau, "state": state, "value": value}, batch_size=[len(tau)])


def _face_pool(problem: ReachAvoidProblem, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    given = problem.faces(FACE_POOL, generator)
    if given is not None:
        points, values = given
        return points.to(torch.get_default_dtype()), values.to(torch.get_default_dtype())
    wide = problem.states.expand(2.0)
    candidates = wide.sample(4 * FACE_POOL, generator, dtype=torch.float64)
    reached, failed = problem.reached(candidates), problem.failed(candidates)
    outside = candidates[~(reached | failed)]
    points, values = [], []
    for inside, absorbs, value in (
        (candidates[reached], problem.reached, 1.0),
        (candidates[failed], problem.failed, 0.0),
    ):
        if len(inside) and len(outside):
            count = FACE_POOL // 2
            a = inside[torch.randint(len(inside), (count,), generator=generator)]
            b = outside[torch.randint(len(outside), (count,), generator=generator)]
            face = _bisect(absorbs, a, b)
            near = wide.contains(face)
            points.append(face[near])
            values.append(torch.full((int(near.sum()),), value))
    if not points:
        raise ProblemError(
            f"{type(problem).__name__}: neither target nor avoid set found among {len(candidates)} points of {wide}; "
            "give faces(count, generator) for sets this thin"
        )
    return torch.cat(points).to(torch.get_default_dtype()), torch.cat(values).to(torch.get_default_dtype())


def _bisect(absorbs, inside: Tensor, outside: Tensor) -> Tensor:
    """The point of each segment (N, n) from inside to outside at which it leaves the set."""
    for _ in range(BISECTIONS):
        middle = (inside + outside) / 2
        held = absorbs(middle).unsqueeze(-1)
        inside, outside = torch.where(held, middle, inside), torch.where(held, outside, middle)
    return inside
