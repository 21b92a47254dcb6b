"""The linear-quadratic regulator about the equilibrium in the target, what a control engineer would try first."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import solve_continuous_are
from scipy.optimize import least_squares
from torch import Tensor

from pirl_rl.arguments import Policy
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.faces import find_faces
from pirl_rl.simulator import Simulator

REST = 1e-3
"""The largest distance from rest of an equilibrium, as the share of the box that the drift crosses in the horizon."""


def linear_quadratic(problem: ReachAvoidProblem, simulator: Simulator, seconds: float, seed: int) -> Policy:
    """The feedback u = u0 - K (x - x0), clipped to the box of controls.

    (x0, u0) is an equilibrium inside the target, or for an invariance problem in the middle of the safe set. K solves
    the Riccati equation of the drift's linearisation, whose costs weigh a deviation by the square of the widths of the
    target (or else of the box of states) and of the box of controls, the rule of A. E. Bryson and Y. C. Ho (Applied
    Optimal Control, 1975).

    Args:
        problem: the physics.
        simulator: not used, like `seconds` and `seed`: there is nothing to train.
        seconds: not used.
        seed: not used.

    Raises:
        ArgumentError: there is no equilibrium in the target, or the linearisation cannot be stabilised.
    """
    middle, widths = _middle(problem)
    rest, control = _equilibrium(problem, middle, widths)
    gain = _gain(problem, rest, control, widths)

    def policy(tau: Tensor, x: Tensor) -> Tensor:
        away = problem.states.wrap(x - rest.to(x) + problem.states.center_and_half_width(x)[0])
        away = away - problem.states.center_and_half_width(x)[0]
        low, high = x.new_tensor(problem.controls.low), x.new_tensor(problem.controls.high)
        return (control.to(x) - away @ gain.to(x).mT).clamp(low, high)

    return policy


def _middle(problem: ReachAvoidProblem) -> tuple[Tensor, Tensor]:
    """The middle of the target, or of the safe set, and half of its widths, from points of the faces (n,), (n,)."""
    points, values = find_faces(problem, torch.Generator().manual_seed(0))[:2]
    points = points[values > 0.5] if problem.objective == "reach-avoid" else points
    low, high = points.double().amin(0), points.double().amax(0)
    return (low + high) / 2, (high - low) / 2


def _equilibrium(problem: ReachAvoidProblem, middle: Tensor, widths: Tensor) -> tuple[Tensor, Tensor]:
    """The state (n,) nearest to the middle and the control (m,) at which the drift vanishes."""
    n, half = problem.states.dim, problem.states.center_and_half_width(middle)[1]
    room = problem.controls.center_and_half_width(middle)

    def residual(z: np.ndarray) -> np.ndarray:
        x, u = middle + widths * torch.as_tensor(z[:n]), room[0] + room[1] * torch.as_tensor(z[n:])
        drift = problem.drift(x.unsqueeze(0), u.unsqueeze(0))[0] * problem.horizon / half
        return np.concatenate([drift.numpy(), 1e-6 * z])

    size = n + problem.controls.dim
    found = least_squares(residual, np.zeros(size), bounds=(-np.ones(size), np.ones(size)))
    if np.abs(found.fun[:n]).max() > REST:
        raise ArgumentError("lqr: expected a state at rest in the target, found none")
    z = torch.as_tensor(found.x)
    return middle + widths * z[:n], room[0] + room[1] * z[n:]


def _gain(problem: ReachAvoidProblem, rest: Tensor, control: Tensor, widths: Tensor) -> Tensor:
    """The gain K (m, n)."""

    def drift(x: Tensor, u: Tensor) -> Tensor:
        return problem.drift(x.unsqueeze(0), u.unsqueeze(0))[0]

    slope, effect = torch.func.jacrev(drift, (0, 1))(rest, control)
    half = problem.controls.center_and_half_width(rest)[1]
    try:
        costs = solve_continuous_are(slope, effect, np.diag(1 / widths.numpy() ** 2), np.diag(1 / half.numpy() ** 2))
    except np.linalg.LinAlgError as error:
        raise ArgumentError(f"lqr: expected a drift that can be stabilised at rest in the target: {error}") from None
    return torch.as_tensor(np.diag(half.numpy() ** 2) @ effect.numpy().T @ costs)
