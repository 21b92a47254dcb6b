"""Monte Carlo estimates of a policy's value, by simulation of the problem's own SDE.

The value of a policy pi at (tau, x) is E[l_eps(X at the exit, or at the end)], a mean of payoffs in [0, 1]: with the
hard payoff the probability to reach A before B within tau, in an invariance problem that to stay out of B.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import NormalDist
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator, Step, exit_value

Policy = Callable[[Tensor, Tensor], Tensor]
Array = TypeVar("Array", float, np.ndarray, Tensor)

CHUNK = 32_768
"""Paths simulated at once: bounds the memory, and keeps a step in a core's cache."""

STEP_TOLERANCE = 1e-4
"""tau may exceed whole steps by this part of one without a further step: rounding of tau in float32."""


class Estimate(NamedTuple):
    """Means (N,) of `rollouts` payoffs and the ends (N,) of their intervals, in the kind of array that came in."""

    probability: Tensor | np.ndarray
    low: Tensor | np.ndarray
    high: Tensor | np.ndarray
    rollouts: int


def wilson_interval(successes: Array, trials: int, confidence: float = 0.95) -> tuple[Array, Array]:
    """The score interval {p : |p_hat - p| <= z sqrt(p (1 - p) / trials)} (Wilson 1927).

    For payoffs between 0 and 1 it is conservative: p (1 - p) is the largest variance that a mean of p allows.

    Args:
        successes: their number, or the sum of the payoffs, in [0, trials].
        trials: at least 1.
        confidence: in (0, 1).
    """
    if trials < 1 or not 0 < confidence < 1:
        raise ArgumentError(
            f"wilson_interval: expected trials >= 1 and 0 < confidence < 1, got {trials} and {confidence}"
        )
    z2 = NormalDist().inv_cdf((1 + confidence) / 2) ** 2 / trials

    def lower(p: Array) -> Array:
        # The product of both ends is p^2 / (1 + z^2/n): exactly 0 at p = 0, where their difference would round.
        return p**2 / (p + z2 / 2 + (z2 * (p * (1 - p) + z2 / 4)) ** 0.5)  # type: ignore[return-value]

    p = successes / trials
    return lower(p), 1 - lower(1 - p)  # type: ignore[arg-type, return-value]


def monte_carlo(
    problem: ReachAvoidProblem,
    policy: Policy,
    tau: float | Tensor | np.ndarray,
    x: Tensor | np.ndarray,
    rollouts: int = 1000,
    dt: float = 0.01,
    substeps: int = 1,
    crossing: Literal["bridge", "endpoint"] = "bridge",
    seed: int = 0,
    confidence: float = 0.95,
) -> Estimate:
    """The probability that a policy succeeds from each of N states, with its interval.

    States inside A or B, with tau = 0, or known as unreachable have their exact value and an interval of length 0.

    Args:
        policy: physical control, (N,), (N, n) -> (N, m), as tensors.
        tau: time to go (N,) or one for all, s.
        x: states (N, n); arrays other than tensors are simulated in torch's default dtype.
        rollouts: paths from each state.
        dt: control step, s; a state's own step is tau / ceil(tau / dt), so that no time is lost.
        substeps: integration steps in it.
        crossing: how exits are watched, see `pirl_rl.simulator`.
        seed: of the noise; torch's global random generator stays untouched.
        confidence: of the Wilson interval.

    Raises:
        ValueError: naming the argument, what was expected and what was got.
    """
    points = x if isinstance(x, Tensor) else torch.as_tensor(np.asarray(x), dtype=torch.get_default_dtype())
    if points.ndim != 2 or points.shape[-1] != problem.states.dim:
        raise ArgumentError(f"x: expected shape (N, {problem.states.dim}), got {tuple(points.shape)}")
    times = torch.as_tensor(tau, dtype=points.dtype, device=points.device)
    if times.shape not in ((), (len(points),)) or not bool((times >= 0).all()):
        raise ArgumentError(f"tau: expected a number or {len(points)} of them, all >= 0, got {tau}")
    if rollouts < 1:
        raise ArgumentError(f"rollouts: expected >= 1, got {rollouts}")
    simulator, times = Simulator(problem, dt, substeps, crossing), times.expand(len(points))
    rng = torch.Generator(points.device).manual_seed(seed)
    mean = mean_payoff(simulator, policy, times, points, rollouts, rng)
    known = _known(problem, times, points)[0]
    low, high = (torch.where(known, mean, end) for end in wilson_interval(mean * rollouts, rollouts, confidence))
    if isinstance(x, Tensor):
        return Estimate(*(entry.to(points.dtype) for entry in (mean, low, high)), rollouts=rollouts)
    return Estimate(*(entry.cpu().numpy() for entry in (mean, low, high)), rollouts=rollouts)


@torch.no_grad()
def mean_payoff(
    simulator: Simulator, policy: Policy, tau: Tensor, x: Tensor, rollouts: int, rng: torch.Generator
) -> Tensor:
    """Mean payoff (N,), float64, of paths from (tau, x), (N,) and (N, n); arguments as of `monte_carlo`."""
    known, value = _known(simulator.problem, tau, x)
    steps = torch.ceil(tau.double() / simulator.dt - STEP_TOLERANCE).clamp(min=1).long()
    total, unknown = torch.zeros_like(tau, dtype=torch.float64), (~known).nonzero().squeeze(-1)
    count = len(unknown) * rollouts
    for start in range(0, count, CHUNK):
        path = torch.arange(start, min(start + CHUNK, count), device=x.device)
        _add_payoffs(total, simulator, policy, steps, tau / steps, x, unknown[path // rollouts], rng)
    return torch.where(known, value.double(), total / rollouts)


def _known(problem: ReachAvoidProblem, tau: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Where the value needs no simulation, (N,) bool, and the value (N,) there."""
    on_boundary, reached = ~problem.interior(x) | (tau <= 0), problem.reached(x)
    value = exit_value(problem, Step(x, reached & ~problem.failed(x), problem.failed(x)))
    return on_boundary | problem.unreachable(x), value * on_boundary


def _add_payoffs(total: Tensor, simulator: Simulator, policy: Policy, steps, h, x, owner: Tensor, rng) -> None:
    """Simulate one path from each state x[owner] and add its payoff to total[owner]; only live paths are carried."""
    x, left, h = x[owner], steps[owner], h[owner]
    while len(owner):
        step = simulator.step(x, policy(left * h, x).to(x.dtype), rng, dt=h)
        left = left - 1
        alive = ~(step.reached | step.failed) & (left > 0)
        ended = Step(*(entry[~alive] for entry in step))
        total.index_add_(0, owner[~alive], exit_value(simulator.problem, ended).double())
        x, owner, left, h = step.state[alive], owner[alive], left[alive], h[alive]
