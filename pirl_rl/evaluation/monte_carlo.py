"""Monte Carlo estimates of a policy's value, by simulation of the problem's SDE, Eq. (sde).

The value of a policy at (tau, x) is the expected payoff l_eps in [0, 1] at the path's exit, or at its end. For the
indicator it is the probability to reach A before B within tau or, in an invariance problem, to stay out of B.
"""

from __future__ import annotations

from numbers import Integral, Real
from statistics import NormalDist
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from pirl_rl.arguments import Policy, checked_points, checked_policy, seeded
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Crossing, Simulator, Step, exit_value
from pirl_rl.time_steps import propose_time_steps

Array = TypeVar("Array", float, np.ndarray, Tensor)

PATHS, DEVICE_PATHS = 2_048, 16_384
"""Number of paths that are simulated at once on the CPU, and on other devices.

On the CPU more of them are no faster, and the environment of the default recipe has as many, so that one compiled
program is enough for both. On a GPU a step of few paths takes as long as one of many.
"""

ENTRIES = 2**24
"""Number of entries of sigma, over all paths that are simulated at once, which bounds the memory with many states."""

COMPILED_FROM = 4_000_000
"""Number of integration steps, over all paths, from which they take less time with the compilation than without."""


class Estimate(NamedTuple):
    """Means (N,) of `rollouts` payoffs and the ends (N,) of their confidence intervals, as tensors or arrays like the
    states they belong to."""

    probability: Tensor | np.ndarray
    low: Tensor | np.ndarray
    high: Tensor | np.ndarray
    rollouts: int


def wilson_interval(successes: Array, trials: int, confidence: float = 0.95) -> tuple[Array, Array]:
    """The score interval {p : |p_hat - p| <= z sqrt(p (1 - p) / trials)} (Wilson 1927).

    Its level is approximate: the interval may miss a probability near 0 or 1 more often than it says. Those of
    `pirl_rl.certificates` are exact. It is conservative for payoffs between 0 and 1, because p (1 - p) is the largest
    variance that a mean of p allows.

    Args:
        successes: number of successes, or sum of the payoffs, in [0, trials].
        trials: number of trials, at least 1.
        confidence: confidence level in (0, 1).

    Returns:
        The lower and the upper end, of the type and shape of `successes`.

    Raises:
        ArgumentError: if there is no trial, or the confidence is not in (0, 1).
    """
    if trials < 1 or not (isinstance(confidence, Real) and 0 < confidence < 1):
        raise ArgumentError(
            f"wilson_interval: expected trials >= 1 and 0 < confidence < 1, got {trials} and {confidence!r}"
        )
    z2 = NormalDist().inv_cdf((1 + confidence) / 2) ** 2 / trials

    def lower(p: Array) -> Array:
        # The ends have the product p^2 / (1 + z^2/n). Dividing it by the upper end gives exactly 0 at p = 0, where the
        # textbook difference would leave a rounding error.
        return p**2 / (p + z2 / 2 + (z2 * (p * (1 - p) + z2 / 4)) ** 0.5)  # type: ignore[return-value]

    p = successes / trials
    return lower(p), 1 - lower(1 - p)  # type: ignore[arg-type, return-value]


def expected_deviation(probability: Tensor, rollouts: int) -> float:
    """The mean of |S/R - p| over probabilities p (N,), where S is the number of successes in R independent rollouts.

    It is what the mean of |V - Monte Carlo| would be if p = V were right. The mean absolute deviation of a binomial
    variable is E|S - R p| = 2 k C(R, k) p^k (1 - p)^(R - k + 1) with k = floor(R p) + 1 (A. de Moivre 1730).
    """
    p, total = probability.double(), torch.tensor(float(rollouts), dtype=torch.float64)
    k = (total * p).floor().clamp(max=rollouts - 1) + 1
    ways = torch.lgamma(total + 1) - torch.lgamma(k + 1) - torch.lgamma(total - k + 1)
    likelihood = torch.exp(ways + torch.xlogy(k, p) + torch.xlogy(total - k + 1, 1 - p))
    return (2 * k * likelihood / total).mean().item()


def monte_carlo(
    problem: ReachAvoidProblem,
    policy: Policy,
    tau: float | Tensor | np.ndarray,
    x: Tensor | np.ndarray,
    rollouts: int = 1000,
    dt: float | None = None,
    substeps: int | None = None,
    crossing: Crossing = "bridge",
    seed: int = 0,
    confidence: float = 0.95,
) -> Estimate:
    """The probability that a policy succeeds from each of N states, with its confidence interval.

    States inside A or B, with tau = 0, or from which the problem knows that the target is out of reach have their exact
    value and an interval of length 0.

    Args:
        problem: the physics.
        policy: maps tau (N,) and x (N, n) to the control (N, m) in SI units, all of them tensors.
        tau: times to go (N,), or one number for all states, in s.
        x: states (N, n); arrays other than tensors are simulated in torch's default dtype.
        rollouts: number of paths from each state.
        dt: longest control step in s; the step of a state is tau / ceil(tau / dt), so that whole steps fill tau. The
            default is that of a training, see `pirl_rl.time_steps`.
        substeps: number of integration steps in a control step. The default is 1 with a given `dt`, else likewise.
        crossing: the rule for the drift of an integration step and for exits within it, see `pirl_rl.simulator`.
        seed: seed of the noise; torch's global random generator is not used.
        confidence: confidence level of the interval, which is approximate (Wilson 1927).

    Raises:
        ArgumentError: with the argument, what was expected and what was got.
    """
    kind = (x.dtype, x.device) if isinstance(x, Tensor) else (torch.get_default_dtype(), torch.device("cpu"))
    times, points = checked_points(problem, tau, x, *kind)
    if points.ndim != 2:
        raise ArgumentError(f"x: expected states of shape (N, {problem.states.dim}), got {tuple(points.shape)}")
    if not (isinstance(rollouts, Integral) and rollouts >= 1):
        raise ArgumentError(f"rollouts: expected an integer >= 1, got {rollouts!r}")
    if dt is None:
        dt, substeps = propose_time_steps(problem, substeps=substeps, crossing=crossing)[:2]
    simulator = Simulator(problem, dt, 1 if substeps is None else substeps, crossing)
    rng = seeded(seed, points.device)
    mean = mean_payoff(simulator, checked_policy(policy, problem), times, points, int(rollouts), rng)
    known = _known(problem, times, problem.states.wrap(points))[0]
    low, high = (torch.where(known, mean, end) for end in wilson_interval(mean * rollouts, rollouts, confidence))
    if isinstance(x, Tensor):
        return Estimate(*(entry.to(points.dtype) for entry in (mean, low, high)), rollouts=rollouts)
    return Estimate(*(entry.cpu().numpy() for entry in (mean, low, high)), rollouts=rollouts)


def paths_at_once(device: torch.device) -> int:
    """The number of paths that are simulated at once on a device, unless they have very many states."""
    return PATHS if device.type == "cpu" else DEVICE_PATHS


@torch.no_grad()
def mean_payoff(
    simulator: Simulator,
    policy: Policy,
    tau: Tensor,
    x: Tensor,
    rollouts: int,
    rng: torch.Generator,
    refinement: int = 1,
) -> Tensor:
    """Mean payoff (N,), float64, of paths from tau (N,) and x (N, n); the arguments are those of `monte_carlo`.

    With `refinement`, each control step is split into so many, without another compilation of the simulator.
    """
    x = simulator.problem.states.wrap(x)
    known, value = _known(simulator.problem, tau, x)
    steps = refinement * simulator.clock.split(tau)[0].clamp(min=1)
    unknown = (~known).nonzero().squeeze(-1)
    if simulator.shared is not None:
        simulator = simulator.shared
    elif simulator.compile is None and rollouts * simulator.substeps * int(steps[unknown].sum()) >= COMPILED_FROM:
        simulator = simulator.compiled
    width = max(1, min(paths_at_once(x.device), ENTRIES // (x.shape[-1] * simulator.channels)))
    total = _total_payoffs(simulator, policy, steps, tau / steps, x, unknown, rollouts, width, rng)
    return torch.where(known, value.double(), total / rollouts)


def _known(problem: ReachAvoidProblem, tau: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """A mask (N,) of the points whose value needs no simulation, and their value (N,)."""
    on_boundary, reached = ~problem.interior(x) | (tau <= 0), problem.reached(x)
    value = exit_value(problem, Step(x, reached & ~problem.failed(x), problem.failed(x), torch.zeros_like(x)))
    return on_boundary | problem.unreachable(x), value * on_boundary


def _total_payoffs(simulator: Simulator, policy: Policy, steps, h, x, starts: Tensor, rollouts: int, width: int, rng):
    """The sums (N,) of the payoffs of `rollouts` paths from each of the states x[starts], and 0 for other states.

    A path from the state x[i], of x (N, n), takes steps[i] of `steps` (N,) control steps of the length h[i] of h (N,),
    in s. At most `width` paths are under way at once; others start where paths end.
    """
    total = torch.zeros_like(h, dtype=torch.float64)
    begun, count = 0, len(starts) * rollouts
    now, left, owner = x[:0], steps[:0], starts[:0]
    while len(owner) or begun < count:
        paths = torch.arange(begun, min(count, begun + width - len(owner)), device=x.device)
        begun, started = begun + len(paths), starts[paths // rollouts]
        now, left, owner = (torch.cat(parts) for parts in ((now, x[started]), (left, steps[started]), (owner, started)))
        action = policy(left * h[owner], now).to(now.dtype)
        step = _step(simulator, now, action, h[owner], width, rng)
        left = left - 1
        alive = ~(step.reached | step.failed) & (left > 0)
        ended = Step(*(entry[~alive] for entry in step))
        total.index_add_(0, owner[~alive], exit_value(simulator.problem, ended).double())
        now, left, owner = step.state[alive], left[alive], owner[alive]
    return total


def _step(simulator: Simulator, x: Tensor, u: Tensor, h: Tensor, width: int, rng: torch.Generator) -> Step:
    """A step of up to `width` paths; compiled simulators always play `width` of them, repeating the last one."""
    if not simulator.compile or len(x) == width:
        return simulator.step(x, u, rng, dt=h)
    rows = torch.arange(width, device=x.device).clamp(max=len(x) - 1)
    return Step(*(entry[: len(x)] for entry in simulator.step(x[rows], u[rows], rng, dt=h[rows])))
