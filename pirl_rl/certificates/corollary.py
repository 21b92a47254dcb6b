"""Corollary 1 of the paper as numbers: a diagnostic, and no bound.

The corollary, Eq. (error_upper_bound), bounds the error of the networks' V in D = (0, T) x O, with O outside A_eps and
B, by

    delta_BC~ + C delta_PDE~.

Here delta_BC and delta_PDE are the means of |V - l_eps| on the parabolic boundary and of |L^pi V| in D, and the tilde
stands for the largest values that functions with these means and with their Lipschitz constants can have. The paper
says of three things in it no more than that they exist:

- C. By Dynkin's formula, V minus the value of the policy is the expectation of V - l_eps where the path ends, minus
  that of the integral of L^pi V along it. A path ends within T, so that C = T suffices.
- The Lipschitz constants. They are estimated from slopes, see `pirl_rl.certificates.lipschitz`.
- The geometry. D, its end at tau = 0 and the faces of the sets are taken for cubes [-1, 1]^d. O is sampled in the box
  of states, and the faces by the law by which the package finds them.

So the result bounds nothing. It is shown beside the error itself, and beside delta_BC~ + T delta_PDE~ with the largest
sampled values in place of those with a tilde: with C = T, no Lipschitz constants lead to less.
"""

from __future__ import annotations

from functools import reduce
from operator import or_

from torch import Tensor

from pirl_rl.certificates.bounds import check_level
from pirl_rl.certificates.diagnostic import Diagnostic
from pirl_rl.certificates.field import Field, field_of, unmet_assumptions
from pirl_rl.certificates.residuals import SHARE, Part, measure
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.inputs import like, points_rng
from pirl_rl.evaluation.monte_carlo import expected_deviation
from pirl_rl.evaluation.rollout_comparison import RolloutComparison
from pirl_rl.problem import closed_form
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

POINTS = 16_384
"""The number of points inside and at tau = 0."""

STATES, ROLLOUTS = 256, 256
"""The numbers of states, and of paths from each, for the error where the exact value is not known."""

NAMES = {"inside": "L^pi V in 1/s", "start": "V minus the data at tau = 0", "faces": "V minus the data on the faces"}
"""What the parts are, in words."""


def diagnose(solution: Solution, simulator: Simulator, confidence: float, seed: int) -> Diagnostic:
    """The numbers of Corollary 1 for a solution, beside the error that they are about.

    Args:
        solution: the problem, the policy and V.
        simulator: plays the policy where the exact value is not known.
        confidence: the level of the bounds of the parts, in (0.5, 1).
        seed: seed of all points and of the noise.

    Raises:
        ArgumentError: the solution has no networks, the confidence is out of range, or from hardly any state of the box
            is the target in reach.
    """
    check_level("confidence", confidence)
    if confidence <= 0.5:
        raise ArgumentError(f"confidence: expected a number above 0.5 with corollary=true, got {confidence}")
    rng, field = points_rng(seed), field_of(solution)
    inside, parts = measure(field, POINTS, confidence, rng)
    tau, x = inside.tau, inside.x
    error, words = _exact_error(field, tau, x) or _played_error(solution, simulator, tau[:STATES], x[:STATES], seed)
    unmet = unmet_assumptions(solution, rng)
    numbers = right_hand_side(parts, field.problem.horizon)
    return Diagnostic(
        method="Corollary 1 of the paper with C = T; Lipschitz constants estimated as by Wood and Zhang 1996",
        sentences=(
            *_summary(numbers, parts),
            *(_described(name, part, confidence) for name, part in parts.items()),
            words,
            f"Assumptions of the corollary that do not hold: {'; '.join(unmet) or 'none is seen'}.",
        ),
        numbers=reduce(or_, (part.numbers(name) for name, part in parts.items()), numbers) | error,
    )


def right_hand_side(parts: dict[str, Part], horizon: float) -> dict[str, float | None]:
    """delta_BC~ + T delta_PDE~, and the same with the largest sampled values in place of those with a tilde."""
    rest, inside = [part for name, part in parts.items() if name != "inside"], parts["inside"]
    return {
        "right_hand_side": max(part.everywhere for part in rest) + horizon * inside.everywhere,
        "right_hand_side_sampled": max(part.largest for part in rest) + horizon * inside.largest,
    }


def _summary(side: dict[str, float | None], parts: dict[str, Part]) -> tuple[str, str]:
    total, sampled = side.values()
    endless = [NAMES[name] for name, part in parts.items() if part.lipschitz.upper is None]
    note = (
        f" The slopes of {' and of '.join(endless)} show no end, so that their largest samples stand for Lipschitz "
        "constants, which are too small."
    )
    return (
        f"This bounds nothing. The right-hand side of Corollary 1 is {total:.3g} with estimated Lipschitz constants, "
        f"and {sampled:.3g} with the largest sampled values in place of what they lead to.",
        "An error of a probability is at most 1." + (note if endless else ""),
    )


def _described(name: str, part: Part, confidence: float) -> str:
    return (
        f"{NAMES[name]}, at {part.points:,} points: {part.mean:.3g} in the mean of absolute values, at most "
        f"{part.largest:.3g}; at all but {SHARE:.0%} of the points at most {part.almost:.3g}, with confidence "
        f"{confidence:g}."
    )


def _exact_error(field: Field, tau: Tensor, x: Tensor) -> tuple[dict[str, float | None], str] | None:
    """The error of V where the exact value is known, which is that of the indicator."""
    exact = closed_form(field.problem, tau, x)
    if exact is None:
        return None
    error = field.value(tau, x) - exact
    mean, largest, above = error.abs().mean().item(), error.abs().max().item(), error.max().item()
    return (
        {"error_mean": mean, "error_largest": largest, "error_above": above},
        f"The error itself, at the same points inside: V is {mean:.3g} from the exact value in the mean, at most "
        f"{largest:.3g}, and at most {above:.3g} above it.",
    )


def _played_error(
    solution: Solution, simulator: Simulator, tau: Tensor, x: Tensor, seed: int
) -> tuple[dict[str, float | None], str]:
    """The distance of V from the mean payoff of the policy's paths."""
    tau, x = like(solution, tau, x)
    played = RolloutComparison.measure(solution, simulator, tau, x, ROLLOUTS, seed)
    gap = (played.raw_value - played.monte_carlo).abs()
    mean, largest, noise = gap.mean().item(), gap.max().item(), expected_deviation(played.value, ROLLOUTS)
    return (
        {"error_mean": mean, "error_largest": largest, "error_noise": noise},
        f"The error itself, at {len(tau)} of the points inside: V is {mean:.3g} from Monte Carlo of the policy in the "
        f"mean, of which {noise:.3g} is noise, and at most {largest:.3g}.",
    )
