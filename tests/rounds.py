"""An outer loop without its trainings: histories, requests, plans, and a launcher that only writes summaries."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.advisors.greedy import Greedy
from pirl_rl.outer_loop.history import History, Result, Round
from pirl_rl.outer_loop.loop import Loop, LoopSettings
from pirl_rl.outer_loop.parsing import parse_plan
from pirl_rl.outer_loop.plan import Candidate, Plan
from pirl_rl.outer_loop.processes import Job
from pirl_rl.outer_loop.prompt import render
from pirl_rl.outer_loop.record import Record

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
    """The history with one more round from a valid plan; `play` returns changes to the result of each candidate."""
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


def improves(candidate: Candidate) -> dict:
    return {"metrics": {"reward": 0.8, "calibration_mae": 0.1 / (1 + sum(candidate.schedule_final[1:]))}}


def fate(rng: np.random.Generator):
    """A random outcome of a candidate."""

    def play(candidate: Candidate) -> dict:
        status = rng.choice(["done", "done", "collapsed", "failed"])
        metrics = {
            "reward": rng.choice([0.8, 0.85, 0.795, 0.3]),
            "calibration_mae": rng.choice([0.01, 0.2, rng.random()]),
        }
        if status == "failed" or rng.random() < 0.1:
            metrics = {}
        return {"status": status, "metrics": metrics} | ({"checkpoint": None} if status == "failed" else {})

    return play


def _kept(candidate: Candidate, record: History, name: str) -> float | None:
    value = getattr(candidate, name)
    return getattr(record.checkpoints[candidate.start_checkpoint], name) if value is None else value


BASE = Result(
    checkpoint="start",
    weights=(1.0, 0.1, 1.0),
    collocation_jitter=0.03,
    collocation_replay_share=0.9,
    metrics={"reward": 0.8, "success_rate": 0.8, "calibration_mae": 0.05, "success_low": 0.79, "success_high": 0.81},
)


QUIET = {"reward": 0.8, "calibration_mae": 0.04, "success_rate": 0.8}


class Killed(BaseException):
    """An exception that stands for SIGKILL."""


class Clock:
    """Raises `Killed` at the k-th of the counted moments."""

    def __init__(self, last: int = -1):
        self.moments, self.last = 0, last

    def tick(self) -> None:
        if self.moments == self.last:
            raise Killed
        self.moments += 1


class FakeTrain:
    """A launcher that trains nothing: its summaries follow from a candidate's settings alone."""

    def __init__(self, summaries=None, clock: Clock | None = None):
        self.summaries, self.clock = summaries or {}, clock or Clock()
        self.commands: list[tuple[str, ...]] = []

    def run(self, jobs, ended) -> None:
        for one in jobs:
            self.commands.append(one.command)
            ended(one, self._train(one))

    def _train(self, one: Job) -> int:
        assert one.command[:3] == (sys.executable, "-m", "pirl_rl.train")
        settings = dict(text.partition("=")[::2] for text in one.command[3:])
        folder = one.log.with_suffix("")
        self.clock.tick()
        if "resume" in settings:
            assert Path(settings["resume"]) == folder
            text = (folder / "settings").read_text()
        else:
            assert settings["hydra.run.dir"] == f"'{folder}'"
            folder.mkdir(parents=True)
            text = "\n".join(f"{name}={settings[name]}" for name in settings if name.startswith(("schedule", "++coll")))
            (folder / "settings").write_text(text)
            self.clock.tick()
            (folder / "checkpoints").mkdir()
            (folder / "checkpoints" / "last.pt").touch()
            self.clock.tick()
        summary = self.summaries.get(one.name) or {**QUIET, "calibration_mae": number(text)}
        if "exit" in summary:
            one.log.write_text(f"begun in {folder}\nerror: {summary['told']}\n")
            return summary["exit"]
        write_json(folder / "summary.json", {"updates": 100, "wall_seconds": time.time(), **summary})
        self.clock.tick()
        return 0


def number(text: str) -> float:
    """In [0.01, 0.05), the same for the same text."""
    return 0.01 + 0.04 * int(hashlib.sha256(text.encode()).hexdigest()[:6], 16) / 16**6


def write_json(path: Path, data) -> None:
    path.write_text(json.dumps(data))


class Scripted:
    """Gives its answers in turn and repeats the last one. Exceptions are raised, callables called with the request."""

    def __init__(self, *answers):
        self.answers, self.requests = list(answers), []

    def propose(self, request):
        self.requests.append(request)
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        answer = answer(request) if callable(answer) else answer
        if isinstance(answer, BaseException):
            raise answer
        return answer


def candidate(name: str = "a", **settings) -> Candidate:
    fields = {
        "schedule_initial": (1.0, 0.1, 1.0),
        "schedule_final": (1.0, 0.2, 2.0),
        "schedule_center": 50.0,
        "schedule_sharpness": 0.1,
    }
    return Candidate(name=name, **(fields | settings))


def answer(*candidates: Candidate, note: str = "why a and b") -> str:
    return Plan(round_note=note, candidates=list(candidates or (candidate("a"), candidate("b")))).model_dump_json()


def greedy(request) -> str:
    return Greedy().propose(request)


def make_loop(out: Path, advisor=None, launcher=None, **settings) -> Loop:
    out.mkdir(exist_ok=True)
    given = {"rounds": 2, "candidates": 2, "updates": 100, "extra_rounds": 0, "start": Path("/some where/last.pt")}
    return Loop(LoopSettings(**given | settings), Record(out), advisor or Greedy(), launcher or FakeTrain())


def run(loop: Loop):
    return loop.run(loop.record.history(BASE, 0.01))
