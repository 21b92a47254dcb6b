"""The verdict on a solution: rules that turn what was measured into solved, doubtful or failed, and sentences.

Differences of success are compared with their standard error, so that a verdict does not hang on noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

Level = Literal["solved", "doubtful", "failed"]

RARE = 0.005
"""A mean success whose interval lies below this is rare."""

GAP, LARGE_GAP = 0.03, 0.10
"""Mean errors of V, without the noise of Monte Carlo, above which a solution is doubtful, and above which it failed."""

BIAS = 0.02
"""A mean of V - Monte Carlo beyond this, in either direction, is doubtful."""

BETTER = 0.02
"""The mean success by which another policy, or another time step, must differ to matter."""

ERRORS = 3.0
"""The number of standard errors by which a difference must exceed 0 to matter."""

FLAT, VARIED = 0.01, 0.05
"""Standard deviations over the states: below the first V is constant, above the second success varies."""

TRAIN_LONGER, WIDEN = "train longer (trainer.updates)", "take wider networks (critic.hidden)"
"""Advice that several reasons share."""

GRID_STATES = 2
"""The largest number of states for which the grid is advised."""


class Difference(NamedTuple):
    """A mean difference of success at the same states, and its standard error."""

    mean: float
    error: float

    def matters(self, least: float = BETTER) -> bool:
        return abs(self.mean) > max(least, ERRORS * self.error)


class Reason(NamedTuple):
    """Why a solution is not solved, and what to do next."""

    level: Literal["doubtful", "failed"]
    why: str
    advice: tuple[str, ...]


@dataclass(frozen=True)
class Measures:
    """What a verdict rests on; probabilities are means over the same states and times to go.

    Attributes:
        success: of the policy.
        low, high: the 95% interval of `success` at these states, over the noise of paths and not over other states.
        random: success of random controls.
        constant: success of the best constant control.
        constant_control: that control, in SI units.
        over_constant: constant minus the policy, with its error.
        ahead: look-ahead minus the policy; None where it was not played.
        grid: the policy of a coarse grid minus the policy; None where it was not played.
        finer: success with shorter time steps minus that with those of the training.
        gap: the mean of |V - Monte Carlo|.
        gap_error: the standard error of `gap`.
        noise: what `gap` would be for a perfect V.
        gap_finer, noise_finer: like `gap` and `noise`, with shorter time steps.
        bias: the mean of V - Monte Carlo, with its error.
        value_spread, success_spread: standard deviations of V and of Monte Carlo over the states.
        still: numbers of the controls that never move.
        gain: the largest gain of V per s that the HJB residual promises for another control, over the states.
        gain_at: the state of `gain`.
        states: the number n of states of the problem.
        invariance: whether the problem asks to stay out of the avoid set.
    """

    success: float
    low: float
    high: float
    random: float
    constant: float
    constant_control: list[float]
    over_constant: Difference
    ahead: Difference | None
    grid: Difference | None
    finer: Difference
    gap: float
    gap_error: float
    noise: float
    gap_finer: float
    noise_finer: float
    bias: Difference
    value_spread: float
    success_spread: float
    still: list[int]
    gain: float
    gain_at: list[float]
    states: int
    invariance: bool = False

    @property
    def error(self) -> float:
        """The mean error of V without the noise of Monte Carlo, whose squares add up."""
        return max(self.gap**2 - self.noise**2, 0.0) ** 0.5

    def is_wrong(self, least: float) -> bool:
        """Whether V is wrong by more than `least` on average, and not by chance."""
        return self.error > least and self.gap - self.noise > ERRORS * self.gap_error


def judge(m: Measures) -> list[Reason]:
    """The reasons against a solution, the gravest first; none if it is solved."""
    return [*_failures(m), *_doubts(m)]


def _failures(m: Measures):
    if not all(number == number for number in (m.success, m.gap, m.value_spread)):
        advice = "lower learner.learning_rate", "check the problem with python -m pirl_rl.check"
        yield Reason("failed", "V or the policy is not a number.", advice)
        return
    others = max(m.random, m.constant)
    if m.success == 0 or (m.high < RARE and others >= RARE):
        also = "nor does a random or a constant control"
        if others > 0:
            also = f"while another control does in {others:.2g} of the paths"
        how = "never" if m.success == 0 else "hardly ever"
        yield Reason("failed", f"The policy {how} {_event(m)}, {also}.", _look_at_sets(m))
    if m.over_constant.mean > 0 and m.over_constant.matters():
        control = _numbers(m.constant_control)
        yield Reason(
            "failed",
            f"The constant control {control} succeeds more often than the policy, by {m.over_constant.mean:.3f}.",
            (TRAIN_LONGER, "train from another seed"),
        )
    if m.value_spread < FLAT and m.success_spread > VARIED:
        yield Reason(
            "failed",
            "V is the same at all states, but success is not.",
            ("lower the weights of the HJB residual and of the boundary (pirl.final), or start them later",),
        )
    if m.is_wrong(LARGE_GAP):
        yield Reason(
            "failed",
            f"V is wrong by {m.error:.2f} on average, measured by Monte Carlo of its own policy.",
            ("look at figures/calibration.png", TRAIN_LONGER, WIDEN),
        )


def _doubts(m: Measures):
    if m.success > 0 and max(m.high, m.random, m.constant) < RARE:
        why = f"The policy {_event(m)} in {m.success:.2g} of the paths, and random and constant controls hardly ever."
        yield Reason("doubtful", why, _look_at_sets(m))
    if not m.is_wrong(LARGE_GAP) and (m.is_wrong(GAP) or m.bias.matters(BIAS)):
        sign = "above" if m.bias.mean > 0 else "below"
        yield Reason(
            "doubtful",
            f"V is wrong by {m.error:.3f} on average, and {abs(m.bias.mean):.3f} {sign} Monte Carlo of its own policy.",
            (TRAIN_LONGER, WIDEN),
        )
    if m.ahead is not None and m.ahead.mean > 0 and m.ahead.matters():
        yield Reason(
            "doubtful",
            f"A policy that looks one control step ahead succeeds more often, by {m.ahead.mean:.3f}.",
            (TRAIN_LONGER, "use run.policy(tau, x, lookahead=1)"),
        )
    if m.grid is not None and m.grid.mean > 0 and m.grid.matters():
        yield Reason(
            "doubtful",
            f"The policy of a coarse grid succeeds more often, by {m.grid.mean:.3f}.",
            (TRAIN_LONGER,),
        )
    if m.finer.matters():
        yield Reason(
            "doubtful",
            f"With shorter time steps success changes by {m.finer.mean:+.3f}.",
            ("take a smaller env.dt, or env.dt=auto",),
        )


def _event(m: Measures) -> str:
    return "stays out of the avoid set" if m.invariance else "reaches the target"


def _look_at_sets(m: Measures) -> tuple[str, ...]:
    """The advice where no path succeeds, or hardly any."""
    wanted = (
        "some control can stay out of the avoid set for the whole horizon" if m.invariance else "the horizon suffices"
    )
    return (f"check the sets with python -m pirl_rl.check, and that {wanted}",)


def describe(m: Measures, reasons: list[Reason]) -> list[str]:
    """At most eight lines for a person."""
    level, why = verdict_of(reasons)
    lines = [f"verdict   {level}: {why}"]
    if len(reasons) > 1:
        lines.append(f"          {' '.join(reason.why for reason in reasons[1:])}")
    others = [
        f", {name} {m.success + other.mean:.3f} ± {other.error:.3f}"
        for name, other in (("one step of look-ahead", m.ahead), ("the policy of a coarse grid", m.grid))
        if other is not None
    ]
    lines.append(f"success   {m.success:.3f} of the policy, 95% interval {m.low:.3f} to {m.high:.3f} at these states")
    lines.append(
        f"beside    random controls {m.random:.3f}, the best constant one, {_numbers(m.constant_control)}, "
        f"{m.constant:.3f}{''.join(others)}"
    )
    lines.append(
        f"value     mean |V - Monte Carlo| {m.gap:.4f}, of which noise {m.noise:.4f}; with shorter steps "
        f"{m.gap_finer:.4f}, of which noise {m.noise_finer:.4f}"
    )
    if m.gain > 0:
        lines.append(f"residual  another control raises V by up to {m.gain:.3g} per s, most at {_numbers(m.gain_at)}")
    if m.still:
        names = f"component {m.still[0]}" if len(m.still) == 1 else f"components {', '.join(map(str, m.still))}"
        lines.append(f"control   {names} of the control never move{'s' if len(m.still) == 1 else ''}")
    if reasons:
        advice = dict.fromkeys(text for reason in reasons for text in reason.advice)
        if m.states <= GRID_STATES and m.ahead is not None:  # which is not played with the policy of a grid
            advice["or solve it on a grid, which takes seconds (method=grid)"] = None
        lines.append(f"next      {'; '.join(advice)}")
    return lines


def verdict_of(reasons: list[Reason]) -> tuple[Level, str]:
    """The level and the first reason."""
    if not reasons:
        return "solved", "V agrees with simulation of its policy, and no other policy that was tried does better."
    return reasons[0].level, reasons[0].why


def _numbers(values: list[float]) -> str:
    shown = ", ".join(f"{value:.3g}" for value in values[:6])
    return f"[{shown}{', ...' if len(values) > 6 else ''}]"
