"""The outer loop with real trainings, programs and a server; a candidate takes seconds, all tests minutes."""

from __future__ import annotations

import json
import os
import random
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import agent
import pytest
from chat_server import Handler, chat, serving
from rounds import BASE, answer, candidate, write_json
from small import DRIFT, TUNED, command, small_trainer, wait_for

from pirl_rl.configuration import CONF
from pirl_rl.outer_loop.record import Record
from pirl_rl.outer_loop.tree import best_path

pytestmark = pytest.mark.slow

SMALL_DRIFT = ("+experiment=drift", "+debug=drift")
KEY = "sk-0123456789abcdef"


@pytest.fixture(scope="module")
def trained_drift(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("drift")
    small_trainer(folder, "trainer.updates=20", base=DRIFT).train()
    return folder


def real(out: str, trained: Path, *arguments: str, small: tuple[str, ...] = TUNED) -> list[str]:
    return [*small, f"start={trained}", "updates=40", f"out={out}", "trainer.checkpoint_every=5", *arguments]


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    environment = {**os.environ, "PYTHONPATH": str(CONF.parent), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "pirl_rl.tune", *arguments]
    return subprocess.Popen(
        line, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def decided(out: Path) -> dict[str, str]:
    """Plans and results, and the training of each candidate, as they are on disk."""
    names = ("plan.json", "results.json", "answer.json", "prompt.md", "metrics.csv")
    found = {path: path.read_text() for path in out.rglob("*") if path.name in names}
    return {str(path.relative_to(out)): text for path, text in sorted(found.items())}


def plans(*names: str) -> list[dict]:
    """Plans in a file: a chain of candidates, one for each round."""
    made = [json.loads(answer(candidate(name, schedule_final=(1, 0.1 * i, 1)))) for i, name in enumerate(names, 1)]
    for i, (before, plan) in enumerate(zip(names, made[1:], strict=False), 1):
        plan["candidates"][0]["start_checkpoint"] = f"{i:03d}/{before}"
    return made


def three_rounds(advisor: str, folder: Path, *arguments: str, **environment: str) -> list[dict]:
    """The results.json of three rounds, with their plans and prompts."""
    done = command(
        *arguments, f"advisor={advisor}", "candidates=1", "rounds=3", cwd=folder, module="pirl_rl.tune", **environment
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    found = []
    for number in (1, 2, 3):
        one = folder / "out" / "rounds" / f"{number:03d}"
        found.append(json.loads((one / "results.json").read_text()))
        found[-1] |= {"plan": json.loads((one / "plan.json").read_text()), "prompt": (one / "prompt.md").read_text()}
        assert (found[-1]["advisor"], found[-1]["fallback"]) == (advisor, "")
        [result] = found[-1]["results"]
        assert result["status"] == "done", result
        assert {"reward", "success_rate", "calibration_mae", "td_loss", "hjb_loss"} <= result["metrics"].keys()
    return found


@pytest.fixture(params=["reach1d", "drift"])
def problem(request) -> list[str]:
    if request.param == "reach1d":
        return real("out", request.getfixturevalue("trained"))
    return real("out", request.getfixturevalue("trained_drift"), small=SMALL_DRIFT)


@pytest.mark.parametrize("advisor", ["greedy", "optuna"])
def test_three_rounds(advisor, problem, tmp_path):
    rounds = three_rounds(advisor, tmp_path, *problem)
    assert len({str(one["plan"]["candidates"][0]["schedule_final"]) for one in rounds}) == 3


def test_three_rounds_of_a_person(problem, tmp_path):
    write_json(tmp_path / "plans.json", plans("a", "b", "c"))
    rounds = three_rounds("file", tmp_path, *problem, "advisor.path=plans.json")
    assert [one["results"][0]["updates"] for one in rounds] == [40, 80, 120]
    assert best_path(Record(tmp_path / "out").history(BASE, 1.0))[0] == "start"


def test_three_rounds_of_a_program(problem, tmp_path):
    line = f"'{sys.executable}' '{Path(agent.__file__)}' {{prompt}} {{plan}}"
    rounds = three_rounds("command", tmp_path, *problem, f'advisor.command="{line}"')
    follows_the_record(rounds)


def test_three_rounds_of_a_server(problem, tmp_path):
    def advise(handler: Handler) -> None:
        assert handler.headers["Authorization"] == f"Bearer {KEY}"
        text = handler.server.requests[-1][2]["messages"][0]["content"]
        handler.reply(200, chat(json.dumps(agent.advise(text))), {})

    with serving() as server:
        server.script = [(500, b"busy", {}), advise]
        url = f"advisor.base_url=http://127.0.0.1:{server.server_port}/v1"
        settings = (url, "advisor.model=some", "advisor.key_variable=MY_CREDENTIAL")
        rounds = three_rounds("openai", tmp_path, *problem, *settings, MY_CREDENTIAL=KEY)
        assert len(server.requests) == 4
    follows_the_record(rounds)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and KEY.encode() in path.read_bytes()]


def follows_the_record(rounds: list[dict]) -> None:
    """Each plan is the agent's for what it was shown, and what it was shown were the results."""
    for number, one in enumerate(rounds):
        mine, [chosen] = agent.advise(one["prompt"]), one["plan"]["candidates"]
        assert {name: chosen[name] for name in mine["candidates"][0]} == mine["candidates"][0]
        shown = json.loads(one["prompt"].rsplit("```json", 1)[1].split("```")[0])["rounds"]
        assert [r["results"][0]["metrics"] for r in shown] == [r["results"][0]["metrics"] for r in rounds[:number]]
    assert len({one["plan"]["candidates"][0]["schedule_final"][1] for one in rounds}) > 1


def test_parallel_changes_nothing(trained, tmp_path):
    settings = ("rounds=1", "candidates=2")
    for parallel in (1, 2):
        line = real(f"out{parallel}", trained, *settings, f"parallel={parallel}")
        assert command(*line, cwd=tmp_path, module="pirl_rl.tune").returncode == 0
    assert decided(tmp_path / "out1") == decided(tmp_path / "out2")


@pytest.fixture
def hearing():
    """Receive SIGINT, which a shell makes its background processes and their children ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("hearing")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_saves_and_tells_how_to_go_on(number, trained, tmp_path):
    loop = start(tmp_path, *real("out", trained, "rounds=1", "candidates=1", "updates=1000000"))
    run = tmp_path / "out" / "rounds" / "001" / "candidates" / "raise-1"
    wait_for(lambda: (run / "checkpoints" / "last.pt").exists())
    loop.send_signal(number)
    text = loop.communicate(timeout=60)[1]
    assert loop.returncode == 130
    assert "resume with: python -m pirl_rl.tune " in text
    assert "Traceback" not in text
    assert (run.parent / "raise-1.log").read_text().count("resume=") == 1
    assert not (run / "failed.json").exists()
    again = start(tmp_path, *shlex.split(text.rpartition("pirl_rl.tune ")[2]))
    wait_for(lambda: (run.parent / "raise-1.log").read_text().count("resume=") > 1)
    again.send_signal(number)
    again.communicate(timeout=60)
    assert again.returncode == 130


@pytest.mark.parametrize("advisor", ["greedy", "file", "optuna"])
def test_sigkill_at_random_moments_leads_to_the_same_tree(advisor, trained, tmp_path):
    settings = [f"advisor={advisor}", "rounds=3", "candidates=2"]
    if advisor == "file":
        settings[1:] = ["advisor.path=plans.json", "rounds=3", "candidates=1"]
        write_json(tmp_path / "plans.json", plans("a", "b", "c"))
    if advisor == "optuna":
        settings += ["advisor.sampler=tpe", "advisor.seed=3", "advisor.startup=2"]
    began = time.monotonic()
    done = command(*real("whole", trained, *settings), cwd=tmp_path, module="pirl_rl.tune")
    assert done.returncode == 0, done.stderr
    took = time.monotonic() - began
    rng, killed, outs = random.Random(0), 0, ["killed"]
    while killed < 10:
        loop = start(tmp_path, *real(outs[-1], trained, *settings))
        try:
            loop.communicate(timeout=rng.uniform(0.1, 0.5) * took)
            outs.append(f"killed{killed}")  # this candidate has ended, and the next starts from the beginning
        except subprocess.TimeoutExpired:
            loop.kill()
            loop.communicate()
            killed += 1
    for out in outs:
        done = command(*real(out, trained, *settings), cwd=tmp_path, module="pirl_rl.tune")
        assert done.returncode == 0, done.stderr
        assert decided(tmp_path / out) == decided(tmp_path / "whole")
