"""How well the raw V satisfies its equations at held-out points: HJB, boundary and one-step consistency."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.evaluator import Metrics
from pirl_rl.evaluation.inputs import like, noise_rng, points_rng
from pirl_rl.evaluation.reference_states import ReferenceStates
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.boundary import BoundarySampler
from pirl_rl.sampling.collocation import Collocation
from pirl_rl.sampling.initial_states import UniformStates
from pirl_rl.simulator import Simulator, exit_value
from pirl_rl.solution import Solution


class Residuals:
    """Mean squares of the residuals under the noise-free policy, at the same points and noise at every call.

    - hjb_loss: (L^pi V)^2 at Sobol points of (0, T] x states outside A and B. A wrong policy can satisfy it.
    - hjb_sup_loss: (max_u L^u V)^2 at the same points, the HJB equation itself, Eq. (hjb_pde): exposes a reversed
      policy. The maximum is over a grid of controls and the policy's own.
    - value_slope: mean |grad V| at the same points, in the coordinates in which `problem.states` is [-1, 1]^n: a value
      that has collapsed to a constant satisfies the equation too.
    - boundary_loss: (V - l_eps)^2, half of the points at tau = 0, half on the faces of A and B.
    - td_loss: (V(y) - r - (1 - d) V(y'))^2 of one control step from x uniform and whole steps to go. The noise of the
      step leaves the variance of V(y'), about |sigma^T grad V|^2 dt, even to the exact value.

    Args:
        points: of each of the samples.
        states: gives reference states in place of the Sobol points, where most of the box is never visited.
        controls_per_axis: grid of the maximum, vertices included: this to the power m evaluations.
        seed: of points and noise.
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
            "hjb_loss": f"The mean of (L^pi V)^2 in 1/s^2, at {where}: the networks' own V under its own policy.",
            "hjb_sup_loss": "The mean of (max_u L^u V)^2 in 1/s^2, at the same points: the HJB equation itself.",
            "boundary_loss": f"The mean of (V - l_eps)^2 at {points} points, half at tau = 0, half on the faces of A "
            "and B, for the networks' own V.",
            "td_loss": f"The mean of (V(y) - r - (1 - d) V(y'))^2 over {points} transitions of one control step, for "
            "the networks' own V; it includes the variance of V(y').",
            "value_slope": "The mean of |grad V| at the points of hjb_loss, in the coordinates in which the box of "
            "states is [-1, 1]^n.",
        }

    def __call__(self, solution: Solution, simulator: Simulator) -> Metrics:
        rng = points_rng(self.seed)
        tau, x = self._interior(solution, rng)
        along, largest = self._hjb(solution, tau, x)
        losses = {
            "hjb_loss": along,
            "hjb_sup_loss": largest,
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

    def _hjb(self, solution: Solution, tau: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        along = largest = solution.residual(tau, x)
        axis = torch.linspace(-1, 1, self.controls_per_axis).to(tau)
        for action in torch.cartesian_prod(*[axis] * solution.problem.controls.dim).view(
            -1, solution.problem.controls.dim
        ):
            u = solution.problem.controls.denormalize(action).expand(len(x), -1)
            largest = torch.maximum(largest, solution.residual(tau, x, u))
        return along, largest

    def _boundary(self, solution: Solution, rng: torch.Generator) -> Tensor:
        half = self.points // 2
        points = BoundarySampler(solution.problem, self.points - half, half, tau_power=1.0).sample(rng)
        tau, x, value = like(solution, points["tau"].squeeze(-1), points["state"], points["value"])
        return solution.raw_value(tau, x) - value

    def _td(self, solution: Solution, simulator: Simulator, rng: torch.Generator) -> Tensor:
        problem = solution.problem
        max_steps = round(problem.horizon / simulator.dt)
        steps, x = UniformStates().sample(problem, self.points, max_steps, rng, solution.dtype)
        tau, tau_next, x = like(solution, steps * simulator.dt, (steps - 1) * simulator.dt, x)
        step = simulator.step(x, solution.policy(tau, x), noise_rng(solution, self.seed))
        ended = step.reached | step.failed | (steps == 1).to(solution.device)
        target = torch.where(ended, exit_value(problem, step), solution.raw_value(tau_next, step.state))
        return solution.raw_value(tau, x) - target
