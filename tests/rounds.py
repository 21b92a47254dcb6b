"""Rounds of an outer loop without its trainings: histories, requests, plans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.plan import Candidate, History, Result, Round, parse_plan
from pirl_rl.outer_loop.prompt import render

UPDATES = 1_000
GOOD = {"reward": 0.8, "calibration_mae": 0.1}


def history(weights=(1.0, 0.1, 1.0), jitter=None, reward=0.8) -> History:
    share = None if jitter is None else 0.9
    metrics = {**GOOD, "reward": reward}
    start = Result(
        checkpoint="start", weights=weights, metrics=metrics, collocation_jitter=jitter, collocation_replay_share=share
    )
    return History(baseline=start, tolerance=0.01)


def request(record: History, folder: Path = Path("."), candidates: int = 1, updates: int = UPDATES) -> Request:
    number = len(record.rounds) + 1
    return Request(number, candidates, updates, record, render(record, rounds=3, candidates=2, updates=updates), folder)


def plan(*names: str, hjb: float = 0.2) -> dict:
    one = {"schedule_initial": [1, 0.1, 1], "schedule_final": [1, hjb, 1], "schedule_center": 500}
    return {"round_note": "try", "candidates": [{"name": name, **one, "schedule_sharpness": 0.02} for name in names]}


def after(record: History, answer: str, count: int, play: Callable[[Candidate], dict]) -> History:
    """The history with one more round: `play` says what became of each candidate of a plan, which must be valid."""
    number = len(record.rounds) + 1
    candidates = parse_plan(answer, record, count).candidates
    results = [
        Result(
            checkpoint=f"{number:03d}/{candidate.name}",
            candidate=candidate,
            updates=UPDATES * number,
            weights=candidate.schedule_final,
            collocation_jitter=_kept(candidate, record, "collocation_jitter"),
            collocation_replay_share=_kept(candidate, record, "collocation_replay_share"),
        ).model_copy(update=play(candidate))
        for candidate in candidates
    ]
    return record.model_copy(
        update={"rounds": [*record.rounds, Round(number=number, advisor="", note="", results=results)]}
    )


def _kept(candidate: Candidate, record: History, name: str) -> float | None:
    value = getattr(candidate, name)
    return getattr(record.checkpoints[candidate.start_checkpoint], name) if value is None else value
