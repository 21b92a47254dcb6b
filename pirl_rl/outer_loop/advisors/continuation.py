"""What the built-in advisors share: where a round's candidates start, and a sigmoid in units of their length."""

from __future__ import annotations

from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.plan import START


def starts(history: History, count: int) -> list[Result]:
    """The best checkpoint for each candidate; where that is the loop's start, only the first of them restarts from it
    once another checkpoint is sound.
    """
    best = history.best
    others = [result for result in history.results if history.keeps(result)]
    if best.checkpoint != START or not others:
        return [best] * count
    return [best] + [min(others, key=lambda result: result.metrics["calibration_mae"])] * (count - 1)


def sigmoid(updates: int, share: float, slope: float) -> dict[str, float]:
    """Center and sharpness of a candidate's schedule.

    Args:
        updates: its length.
        share: of the length, at which the transition is half done.
        slope: sharpness times length.
    """
    return {
        "schedule_center": rounded(share * updates),
        "schedule_sharpness": rounded(min(slope / updates, 10.0)),  # the schema's limit, met by very short candidates
    }


def rounded(value: float) -> float:
    """Six significant digits: what a person can read and type again."""
    return float(f"{value:.6g}")
