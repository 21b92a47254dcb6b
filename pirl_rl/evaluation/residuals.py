"""Residuals of the learned V at held-out points: HJB equation, boundary condition and one-step consistency."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evaluator import Metrics
from pirl_rl.evaluation.inputs import like, noise_rng, points_rng
from pirl_rl.evaluation.largest_residual import largest_residual
from pirl_rl.evaluation.reference_states import ReferenceStates
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.boundary import BoundarySampler
from pirl_rl.sampling.collocation import Collocation
from pirl_rl.sampling.initial_states import UniformStates
from pirl_rl.simulator import Simulator, exit_value
from pirl_rl.solution import Solution


class Residuals:
    """Mean squares of the residuals of the networks' V under their policy, without exploration noise.

    Points and noise are the same at every call.

    - hjb_loss: (L^pi V)^2, Eq. (linear_pde), at Sobol points of (0, T] and the box of states outside A and B. The value
      of a wrong policy satisfies this equation too.
    - hjb_sup_loss: (max_u L^u V)^2, Eq. (hjb_pde), at the same points, which exposes a wrong policy. The maximum is
      over levels of each control and the policy's control, see `pirl_rl.evaluation.largest_residual`.
    - value_slope: the mean of |grad V| at the same points, in the coordinates in which the box of states is [-1, 1]^n.
      It is 0 for a value that has collapsed to a constant, which satisfies both equations.
    - boundary_loss: (V - l_eps)^2, Eq. (parabolic_boundary), half of the points at tau = 0, half on the faces of A
      and B.
    - td_loss: (V(y) - r - (1 - d) V(y'))^2 over one control step from uniform states. Even the exact value leaves the
      variance of V(y') under the noise of the step, about |sigma^T grad V|^2 dt.

    Args:
        points: number of points of each sample, at least 2.
        states: a callable that returns reference states to use instead of the Sobol points, for problems in which most
            of the box is never visited.
        controls_per_axis: number of levels of each control, bounds included, at least 2.
        seed: seed of points and noise.

    Raises:
        ArgumentError: if there are fewer than two points or two controls per axis.
    """

    def __init__(
        self,
        points: int = 4096,
        states: Callable[[], ReferenceStates] | None = None,
        controls_per_axis: int = 5,
        seed: int = 0,
    ):
        if points < 2 or controls_per_axis < 2:
            raise ArgumentError(
                f"Residuals: expected points, controls_per_axis >= 2, got {points}, {controls_per_axis}"
            )
        self.points, self.states, self.controls_per_axis, self.seed = points, states, controls_per_axis, seed

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        points = f"{self.points:,} held-out"
        where = f"{points} Sobol points outside A and B" if self.states is None else "the reference states"
        return {
            "hjb_loss": f"The mean of (L^pi V)^2 in 1/s^2, at {where}, for the V of the networks alone under the "
            "policy.",
            "hjb_sup_loss": "The mean of (max_u L^u V)^2 in 1/s^2, at the same points: the HJB equation itself.",
            "boundary_loss": f"The mean of (V - l_eps)^2 at {points} points, half at tau = 0, half on the faces of A "
            "and B, for the V of the networks alone.",
            "td_loss": f"The mean of (V(y) - r - (1 - d) V(y'))^2 over {points} transitions of one control step, for "
            "the V of the networks alone; it includes the variance of V(y').",
            "value_slope": "The mean of |grad V| at the points of hjb_loss, in the coordinates in which the box of "
            "states is [-1, 1]^n.",
        }

    def __call__(self, solution: Solution, simulator: Simulator) -> Metrics:
        rng = points_rng(self.seed)
        tau, x = self._interior(solution, rng)
        along = solution.residual(tau, x)
        losses = {
            "hjb_loss": along,
            "hjb_sup_loss": largest_residual(solution, tau, x, along, self.controls_per_axis),
            "boundary_loss": self._boundary(solution, rng),
            "td_loss": self._td(solution, simulator, rng),
        }
        slope = solution.gradient(tau, x) * solution.problem.states.center_and_half_width(x)[1]
        squares = {name: residual.square().mean().item() for name, residual in losses.items()}
        return Metrics({**squares, "value_slope": slope.norm(dim=-1).mean().item()})

    def _interior(self, solution: Solution, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        collocation = Collocation(solution.problem, self.points, sampler="sobol", tau_power=1.0)
        if self.states is None:
            points = collocation.sample(rng)
            tau, x, mask = points["tau"], points["state"], points["mask"]
        else:
            states = self.states()
            tau, x = states.tau.unsqueeze(-1), states.x
            mask = collocation.mask(tau, x)
        return like(solution, tau.squeeze(-1)[mask], x[mask])  # type: ignore[return-value]

    def _boundary(self, solution: Solution, rng: torch.Generator) -> Tensor:
        half = self.points // 2
        points = BoundarySampler(solution.problem, self.points - half, half, tau_power=1.0).sample(rng)
        tau, x, value, weight = like(
            solution, points["tau"].squeeze(-1), points["state"], points["value"], points["weight"]
        )
        return weight.sqrt() * (solution.raw_value(tau, x) - value)

    def _td(self, solution: Solution, simulator: Simulator, rng: torch.Generator) -> Tensor:
        problem = solution.problem
        clock = simulator.clock
        steps, x = UniformStates().sample(problem, self.points, clock.max_steps, rng, solution.dtype)
        tau, tau_next, x = like(solution, clock.time(steps), clock.time(steps - 1), x)
        h = clock.length(steps, clock.shortfall).to(x)
        step = simulator.step(x, solution.policy(tau, x), noise_rng(solution, self.seed), dt=h)
        ended = step.reached | step.failed | (steps == 1).to(solution.device)
        target = torch.where(ended, exit_value(problem, step), solution.raw_value(tau_next, step.state))
        return solution.raw_value(tau, x) - target
