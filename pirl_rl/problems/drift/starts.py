"""Initial states of the episodes of the drifting vehicle."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.problems.drift.problem import VehicleDrift
from pirl_rl.sampling.initial_states import Tau, check_tau, redrawn, steps_to_go


class EquilibriumStates:
    """States around the drift equilibrium at a random friction, displaced in planes of the problem.

    Friction is uniform in the band of the targets. A state is displaced in the beta-r plane, in the e_y-e_psi plane, or
    in both. The displaced coordinates are uniform in the boxes of the planes, contracted towards the equilibrium; the
    others are those of the equilibrium.

    Args:
        scale: factor of the contraction, where 1 gives the whole box and 0 the equilibrium. For two numbers, each state
            draws its factor uniformly between them.
        mixture: shares of the states displaced in the beta-r plane, in the e_y-e_psi plane, and in both.
        tau: the rule for the steps to go, as in `UniformStates`.

    Raises:
        ArgumentError: `scale` or `mixture` is out of range, or `tau` is unknown.
    """

    common = True

    def __init__(
        self,
        scale: float | Sequence[float] = 1.0,
        mixture: Sequence[float] = (0.3, 0.3, 0.4),
        tau: Tau = "random",
    ):
        check_tau(tau)
        low, high = scale if isinstance(scale, Sequence) else (scale, scale)
        if not 0 <= low <= high <= 1 or high == 0:
            raise ArgumentError(
                f"initial_states.scale: expected one or two numbers, 0 <= low <= high <= 1, got {scale}"
            )
        if len(mixture) != 3 or min(mixture) < 0 or not sum(mixture) > 0:
            raise ArgumentError(f"initial_states.mixture: expected three shares >= 0, got {list(mixture)}")
        self.scale, self.mixture = (low, high), tuple(mixture)
        self.tau: Tau = tau

    def sample(
        self,
        problem: VehicleDrift,
        count: int,
        max_steps: int,
        rng: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        if not isinstance(problem, VehicleDrift):
            raise ArgumentError(
                "initial_states: EquilibriumStates gives states of VehicleDrift alone, and the problem is "
                f"{type(problem).__name__}; expected pirl_rl.sampling.UniformStates or one of your own"
            )
        x = redrawn(problem, count, lambda missing: self._draw(problem, missing, rng, dtype))
        return steps_to_go(self.tau, count, max_steps, rng), x

    def _draw(self, problem: VehicleDrift, count: int, rng: torch.Generator, dtype: torch.dtype) -> Tensor:
        device = rng.device
        low, high = problem.friction_band
        friction = low + (high - low) * torch.rand(count, generator=rng, dtype=dtype, device=device)
        center = problem.around_equilibrium(friction)
        shrink = self.scale[0] + (self.scale[1] - self.scale[0]) * torch.rand(
            (count, 1), generator=rng, dtype=dtype, device=device
        )
        shares = torch.tensor(self.mixture, dtype=torch.float64, device=device)
        kind = torch.multinomial(shares, count, replacement=True, generator=rng).unsqueeze(-1)
        chosen = []
        for index, plane in enumerate(problem.planes.values()):
            middle = plane.project(center)
            point = middle + shrink * (plane.box.sample(count, rng, dtype, device) - middle)
            chosen.append(torch.where((kind == index) | (kind == 2), point, middle))
        (beta, r), (e_y, e_psi) = (points.unbind(-1) for points in chosen)
        return problem.around_equilibrium(friction, e_y=e_y, e_psi=e_psi, beta=beta, r=r)
