"""The outer loop with a launcher that trains nothing: its requests, jobs and decisions for answers of any kind."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from rounds import BASE, QUIET, FakeTrain, Scripted, answer, candidate, greedy, make_loop, run

from pirl_rl.errors import AdvisorError
from pirl_rl.outer_loop.plan import Plan
from pirl_rl.outer_loop.report import markdown, write_report
from pirl_rl.outer_loop.tree import best_path


@pytest.mark.parametrize(("rounds", "candidates"), [(1, 1), (3, 2), (2, 4)])
def test_exactly_what_was_asked_is_launched(rounds, candidates, tmp_path):
    launcher = FakeTrain()
    history = run(make_loop(tmp_path, launcher=launcher, rounds=rounds, candidates=candidates))
    assert [len(one.results) for one in history.rounds] == [candidates] * rounds
    assert len(launcher.commands) == len(set(launcher.commands)) == rounds * candidates
    assert len(list(tmp_path.glob("rounds/*/candidates/*/summary.json"))) == rounds * candidates
    assert run(make_loop(tmp_path, launcher=launcher, rounds=rounds, candidates=candidates)) == history
    assert len(launcher.commands) == rounds * candidates


@pytest.mark.parametrize(
    ("improve", "extra", "rounds"),
    [([1, 1, 1, 1, 1], 2, 4), ([1, 1, 0, 1, 1], 2, 3), ([1, 0, 1], 2, 2), ([1, 1, 1], 0, 2), ([0, 1, 0, 1], 3, 3)],
)
def test_extra_rounds_only_while_they_pay(improve, extra, rounds, tmp_path):
    steps = [0.05 - 0.001 * (index + 1) if better else 0.06 for index, better in enumerate(improve)]
    names = [f"{index:03d}/a" for index in range(1, len(steps) + 1)]
    summaries = {
        name: {"reward": 0.8, "calibration_mae": mae, "success_rate": 0.8}
        for name, mae in zip(names, steps, strict=True)
    }
    advisor = Scripted(lambda request: answer(candidate("a", schedule_center=request.number), note="a again"))
    loop = make_loop(tmp_path, advisor, FakeTrain(summaries), candidates=1, rounds=2, extra_rounds=extra)
    history = run(loop)
    assert len(history.rounds) == rounds
    assert history.best.metrics["calibration_mae"] == min(steps[:rounds])


def test_best_is_no_worse_in_reward(tmp_path):
    worse, better = {**QUIET, "reward": 0.7, "calibration_mae": 0.001}, {**QUIET, "reward": 0.795}
    launcher = FakeTrain({"001/a": worse, "001/b": better})
    history = run(make_loop(tmp_path, Scripted(answer()), launcher, rounds=1))
    assert history.best.checkpoint == "001/b"
    assert best_path(history) == ["start", "001/b"]


def test_context_is_read_before_every_round(tmp_path):
    def think(request):
        (tmp_path / "context.md").write_text(f"<!-- hidden -->told in round {request.number}")
        return greedy(request)

    advisor = Scripted(think)
    run(make_loop(tmp_path, advisor))
    first, second = (request.prompt for request in advisor.requests)
    assert "told in round" not in first
    assert "told in round 1" in second
    assert "hidden" not in second
    assert (tmp_path / "rounds" / "002" / "prompt.md").read_text() == second


def test_failed_candidates_do_not_end_the_loop(tmp_path):
    launcher = FakeTrain({f"{index:03d}/{name}": {"exit": 1, "told": "no"} for index in (1, 2) for name in "ab"})
    advisor = Scripted(lambda request: answer(note="a and b again, as nothing ran"))
    history = run(make_loop(tmp_path, advisor, launcher))
    assert {result.status for result in history.results} == {"failed"}
    assert history.best == BASE
    assert len(launcher.commands) == 4


WRONG = {
    "no JSON": "I would raise the weights.",
    "schema": '{"candidates": [1, 2]}',
    "unknown checkpoint": answer(candidate("a", start_checkpoint="009/z"), candidate("b")),
    "negative": answer().replace("0.2", "-0.2"),
    "huge": answer().replace("0.2", "1e30"),
    "infinite": answer().replace("0.2", "Infinity"),
    "NaN": answer().replace("0.2", "NaN"),
    "too many": answer(*(candidate(name) for name in "abcdefgh")),
    "too few": answer(candidate("a")),
    "same name": answer(candidate("a"), candidate("a")),
    "10 MB": answer(note="x") + " " * 10_000_000,
    "path": answer().replace('"name":"a"', '"name":"../../../a"'),
    "absolute path": answer(candidate("a", start_checkpoint="/etc/passwd"), candidate("b")),
    "injection": answer().replace('"name":"a"', '"name":"a; touch stolen; $(touch stolen)"'),
    "override": answer().replace('"name":"a"', '"name":"a","trainer.updates":"1"'),
    "many digits": answer().replace("0.2", "1" * 9_000),
    "nested": "[" * 100_000,
    "bytes": lambda request: answer().encode(),
    "time-out": AdvisorError("no answer within 1 s"),
    "crash": ZeroDivisionError("division by zero"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_bad_advice_is_on_record_and_never_executed(kind, tmp_path):
    launcher, advisor = FakeTrain(), Scripted(WRONG[kind])
    history = run(make_loop(tmp_path, advisor, launcher, rounds=1))
    [one] = history.rounds
    attempts = json.loads((tmp_path / "rounds" / "001" / "answer.json").read_text())
    assert [attempt["advisor"] for attempt in attempts] == ["scripted", "scripted", "greedy"]
    assert all(attempt["errors"] for attempt in attempts[:2])
    assert attempts[2]["errors"] == []
    assert all(len(attempt["answer"]) <= 20_000 for attempt in attempts)
    assert one.advisor == "greedy"
    assert one.fallback == "; ".join(attempts[1]["errors"])
    assert list(advisor.requests[1].errors) == attempts[0]["errors"]
    expected = greedy(replace(advisor.requests[0], errors=()))
    assert [result.candidate for result in one.results] == Plan.model_validate_json(expected).candidates
    assert len(launcher.commands) == 2
    assert {path.name for path in (tmp_path / "rounds" / "001" / "candidates").glob("*/")} == {"raise-1", "raise-2"}


def test_second_answer_counts(tmp_path):
    advisor = Scripted("no", answer())
    [one] = run(make_loop(tmp_path, advisor, rounds=1)).rounds
    assert (one.advisor, one.fallback, one.note) == ("scripted", "", "why a and b")
    assert [bool(request.errors) for request in advisor.requests] == [False, True]


def test_report_of_many(tmp_path):
    history = run(make_loop(tmp_path, rounds=3, candidates=4))
    history.rounds[0].results[0].metrics.pop("success_rate")
    table, figure = write_report(history, tmp_path)
    rows = [line for line in table.read_text().splitlines() if line.startswith("| ")]
    assert len(rows) == 2 + 1 + 12
    assert figure.read_bytes().startswith(b"\x89PNG")
    hostile = history.rounds[0].model_copy(update={"note": "<script>\n| # [x](y)"})
    text = markdown(history.model_copy(update={"rounds": [hostile]}))
    assert r"\<script\> \| \# \[x\](y)" in text
