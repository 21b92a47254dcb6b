"""The default advisor: it raises the HJB and boundary weights while reward holds, and lowers them when it falls."""

from __future__ import annotations

from pirl_rl.errors import ArgumentError
from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.advisors.continuation import rounded, sigmoid, starts
from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.plan import Candidate, Plan

FIRST = 1e-3
"""The first positive value of a weight that was zero, of the order of the paper's first value."""

NEGLIGIBLE = 1e-9
"""Weights up to this value count as zero."""

FIRST_JITTER = 0.005
"""The smallest value to which the jitter is raised."""

MOST_WEIGHT = 1e3
"""The largest weight that a plan allows."""

POWERS = (1, 1 / 2, 1 / 4, 1 / 8, 0, *range(-1, -65, -1))
"""The powers of `growth` by which weights are multiplied, in the order in which they are tried. The weights are raised
by smaller and smaller steps, then held, then lowered."""


class Greedy:
    """A deterministic advisor that has a valid plan for any history, and is the fallback for other advisors.

    HJB and boundary weights are multiplied by powers of `growth`. The candidates of a round take different powers, and
    none takes weights that are at least those of a fallen candidate from the same start, that is one that lost reward,
    collapsed or failed. The TD weight and the replay share are kept. The jitter rises with the weights. It is held when
    reward is below the baseline's or one candidate has fallen, and reduced with each further fall.

    Args:
        growth: largest factor of the weights in a round, in (1, 10].
        jitter_growth: factor of the jitter in a round, in (1, 10].
        most_jitter: largest jitter, in half widths of the box of states, in [0, 1].

    Raises:
        ArgumentError: if an argument is out of its range.
    """

    def __init__(self, growth: float = 2.0, jitter_growth: float = 1.25, most_jitter: float = 0.1):
        if not 1 < growth <= 10 or not 1 < jitter_growth <= 10:
            raise ArgumentError(
                f"growth and jitter_growth: expected 1 < factor <= 10, got {growth} and {jitter_growth}"
            )
        if not 0 <= most_jitter <= 1:
            raise ArgumentError(f"most_jitter: expected a number from 0 to 1, got {most_jitter}")
        self.growth, self.jitter_growth, self.most_jitter = growth, jitter_growth, most_jitter

    def propose(self, request: Request) -> str:
        used = {result.candidate.settings for result in request.history.results if result.candidate is not None}
        chosen: list[Candidate] = []
        for number, start in enumerate(starts(request.history, request.candidates), 1):
            chosen.append(self._next(start, request, number, used))
            used.add(chosen[-1].settings)
        plan = Plan(round_note="; ".join(map(_describe, chosen))[:4_000], candidates=chosen)
        return plan.model_dump_json(indent=1, exclude_none=True)

    def _next(self, start: Result, request: Request, number: int, used: set[tuple]) -> Candidate:
        """The first new candidate with lower weights than all that fell from this start, or the last new candidate."""
        fell = _fallen(start, request.history)
        jitter = self._jitter(start, request.history, len(fell))
        options = (self._candidate(start, power, jitter, number, request.updates) for power in POWERS)
        fresh = (option for option in options if option.settings not in used)
        option = None
        for option in fresh:
            if not any(_as_large(option, other) for other in fell):
                break
        return option or self._candidate(start, POWERS[-1], jitter, number, request.updates)

    def _candidate(self, start: Result, power: float, jitter: float | None, number: int, updates: int) -> Candidate:
        td, *physics = start.weights
        final = [self._weight(weight, power) for weight in physics]
        verb = "raise" if sum(final) > sum(physics) else "lower" if sum(final) < sum(physics) else "hold"
        return Candidate(
            name=f"{verb}-{number}",
            start_checkpoint=str(start.checkpoint),
            schedule_initial=start.weights,
            schedule_final=(td, final[0], final[1]),
            collocation_jitter=jitter,
            **sigmoid(updates, share=0.5, slope=20.0),
        )

    def _weight(self, initial: float, power: float) -> float:
        if power == 0:
            return initial
        base = initial if initial > NEGLIGIBLE else FIRST / self.growth
        return min(rounded(base * self.growth**power), MOST_WEIGHT)

    def _jitter(self, start: Result, history: History, falls: int) -> float | None:
        """The jitter at the end of the schedule, or None to keep that of the start."""
        initial = start.collocation_jitter
        if initial is None:
            return None
        if falls > 1:
            return min(rounded(initial / self.jitter_growth ** (falls - 1)), 1.0)
        weak = start.metrics["reward"] < history.baseline.metrics["reward"]
        raised = rounded(max(initial * self.jitter_growth, FIRST_JITTER))
        return None if falls or weak or raised > self.most_jitter else raised


def _fallen(start: Result, history: History) -> list[Candidate]:
    """The candidates from a checkpoint that lost reward, collapsed or failed."""
    return [
        result.candidate
        for result in history.results
        if result.candidate is not None
        and result.candidate.start_checkpoint == start.checkpoint
        and not history.keeps(result)
    ]


def _as_large(option: Candidate, other: Candidate) -> bool:
    """Whether the final HJB and boundary weights of a candidate are at least those of another."""
    return all(a >= b for a, b in zip(option.schedule_final[1:], other.schedule_final[1:], strict=True))


def _describe(candidate: Candidate) -> str:
    (_, *before), (_, *after) = candidate.schedule_initial, candidate.schedule_final
    jitter = "" if candidate.collocation_jitter is None else f", jitter to {candidate.collocation_jitter:g}"
    return (
        f"{candidate.name} from {candidate.start_checkpoint}: HJB weight {before[0]:g} to {after[0]:g}, "
        f"boundary weight {before[1]:g} to {after[1]:g}{jitter}"
    )
