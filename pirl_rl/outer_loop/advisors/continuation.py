"""Parts that the built-in advisors share: the starts of a round's candidates, and the shape of their schedules."""

from __future__ import annotations

from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.plan import START


def starts(history: History, count: int) -> list[Result]:
    """The start of each of `count` candidates: the best checkpoint.

    If that is the loop's start and another result is sound, only the first candidate restarts from it, and the others
    start from the best of these results.
    """
    best = history.best
    others = [result for result in history.results if history.keeps(result)]
    if best.checkpoint != START or not others:
        return [best] * count
    return [best] + [min(others, key=lambda result: result.metrics["calibration_mae"])] * (count - 1)


def sigmoid(updates: int, share: float, slope: float) -> dict[str, float]:
    """Center and sharpness of a candidate's schedule.

    Args:
        updates: number of updates of the candidate.
        share: center as a share of these updates.
        slope: sharpness times the number of updates.
    """
    return {
        "schedule_center": rounded(share * updates),
        "schedule_sharpness": rounded(min(slope / updates, 10.0)),  # a plan allows 10 at most
    }


def rounded(value: float) -> float:
    """Round to six significant digits, so that plans are easy to read."""
    return float(f"{value:.6g}")
