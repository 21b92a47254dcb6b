"""Programs as advisors: they run without a shell, leave no process behind, and their faults are reported."""

from __future__ import annotations

import fcntl
import json
import os
import sys
import traceback
from dataclasses import replace
from pathlib import Path

import pytest
from rounds import after, history, improves, request

from pirl_rl.errors import AdvisorError, PlanError
from pirl_rl.outer_loop.advisors.command import TAIL, Command
from pirl_rl.outer_loop.parsing import parse_plan
from pirl_rl.outer_loop.prompt import request_text

AGENT = (Path(__file__).parent / "agent.py").read_text()


@pytest.fixture
def program(tmp_path):
    """An advisor that runs a Python script."""
    folder = tmp_path / "programs"
    folder.mkdir()

    def make(source: str, timeout: float = 60.0, arguments: str = "{prompt} {plan}") -> Command:
        path = folder / "agent.py"
        path.write_text(source)
        return Command(f"'{sys.executable}' -I -S '{path}' {arguments}", timeout)

    return make


@pytest.fixture
def folder(tmp_path):
    """The folder of a round, whose name a shell or a template would misread."""
    path = tmp_path / "a b; touch {plan} $(touch proof) '\""
    path.mkdir()
    return path


def test_a_program_plans_from_the_record(program, folder):
    record, agent = history(), program(AGENT)
    for hjb in (0.3, 0.9, 2.7):
        record = after(record, agent.propose(request(record, folder)), 1, improves)
        assert record.results[-1].weights[1] == pytest.approx(hjb)
    assert not list(folder.iterdir())


def test_a_program_is_told_what_was_wrong(program, folder):
    again = replace(request(history(), folder), errors=["candidates: expected exactly 2,\n# got 1"])
    assert json.loads(program(AGENT).propose(again))["round_note"] == "again"
    copy = program("import shutil, sys; shutil.copy(*sys.argv[1:])")
    assert copy.propose(again) == request_text(again)
    assert "- candidates: expected exactly 2, # got 1\n" in request_text(again)
    assert copy.propose(replace(again, errors=())) == again.prompt


def test_no_shell_and_no_file_but_its_own(program, folder):
    (folder / "plan.json").write_text("kept")
    source = "import json, os, sys; json.dump([os.getcwd(), sys.argv[1:]], open(sys.argv[2][5:], 'w'))"
    agent = program(source, arguments="'$(touch proof) > proof;' file:{plan} --in={prompt}")
    where, [literal, plan_file, prompt_file] = json.loads(agent.propose(request(history(), folder)))
    assert Path(where) == folder
    assert literal == "$(touch proof) > proof;"
    assert {Path(plan_file[5:]).parent, Path(prompt_file[5:]).parent} == {folder}
    assert [path.name for path in folder.iterdir()] == ["plan.json"]
    assert (folder / "plan.json").read_text() == "kept"


BAD = {
    "crash": ("raise RuntimeError('no luck')", "exit code 1; its output ends with: .*no luck"),
    "quiet": ("", "plan.json: cannot be read: No such file"),
    "killed": ("import os; os.abort()", "exit code -6"),
    "huge": ("import sys; open(sys.argv[2], 'w').write('1' * 10_000_000)", "at most 200,000 bytes"),
    "link": ("import os, sys; os.symlink('/etc/passwd', sys.argv[2])", "cannot be read"),
    "pipe": ("import os, sys; os.mkfifo(sys.argv[2])", "cannot be read: not a regular file"),
    "folder": ("import os, sys; os.mkdir(sys.argv[2])", "not a regular file|Is a directory"),
    "flood": ("import sys; sys.stdout.write('x' * 10_000_000); sys.exit(3)", f"exit code 3; .* with: x{{{TAIL}}}$"),
    "terminal": ("import sys; sys.exit('\\x1b[2J\\n' * 9 + 'end')", r"ends with: \[2J[^\x1b\n]*end$"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_a_program_gets_wrong(case, program, folder):
    source, message = BAD[case]
    agent = program(source)
    for _ in range(2):  # files of the first attempt must neither hinder the second nor answer it
        with pytest.raises(AdvisorError, match=message):
            agent.propose(request(history(), folder))


def test_a_stale_plan_is_no_answer(program, folder):
    for attempt in (1, 2):
        (folder / f"advisor-{attempt}-plan.json").write_text("{}")
        with pytest.raises(AdvisorError, match="No such file"):
            program("").propose(replace(request(history(), folder), errors=["wrong"] * (attempt - 1)))


def test_bytes_that_are_no_text_are_no_plan(program, folder):
    answer = program("import sys; open(sys.argv[2], 'wb').write(bytes(range(256)))").propose(request(history(), folder))
    with pytest.raises(PlanError):
        parse_plan(answer, history(), 1)


SLEEPER = """
import fcntl, os, subprocess, sys
lock = open({lock!r}, "w")
fcntl.flock(lock, fcntl.LOCK_EX)
child = subprocess.Popen(["sleep", "600"], pass_fds=[lock.fileno()], start_new_session={escapes})
print("ready", child.pid, file=lock, flush=True)
"""


def test_a_time_out_ends_all_that_a_program_started(program, folder, tmp_path):
    lock = tmp_path / "lock"
    agent = program(SLEEPER.format(lock=str(lock), escapes=False) + "child.wait()", timeout=2.0)
    with pytest.raises(AdvisorError, match="longer than 2 s"):
        agent.propose(request(history(), folder))
    with lock.open() as file:
        assert file.read().startswith("ready")
        fcntl.flock(file, fcntl.LOCK_EX)  # the sleeping process holds this lock until it ends


def test_a_program_leaves_no_process_behind(program, folder, tmp_path):
    lock = tmp_path / "lock"
    agent = program(SLEEPER.format(lock=str(lock), escapes=False) + "open(sys.argv[2], 'w').write('{}')")
    assert agent.propose(request(history(), folder)) == "{}"
    with lock.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)


def test_a_process_that_escapes_holds_nothing_up(program, folder, tmp_path):
    lock = tmp_path / "lock"
    agent = program(SLEEPER.format(lock=str(lock), escapes=True) + "print('off', flush=True); sys.exit(1)")
    try:
        with pytest.raises(AdvisorError, match="ends with: off"):
            agent.propose(request(history(), folder))
    finally:
        os.kill(int(lock.read_text().split()[1]), 9)


def test_a_program_s_secrets_are_not_told(program, folder, monkeypatch):
    monkeypatch.setenv("MY_AGENT_TOKEN", "tok-123456789")
    with pytest.raises(AdvisorError, match=r"\[removed\]") as caught:
        program("import os, sys; sys.exit(os.environ['MY_AGENT_TOKEN'])").propose(request(history(), folder))
    assert "tok-123456789" not in "".join(traceback.format_exception(caught.value))


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("agent {prompt}", r"expected \{plan\}"),
        ("", r"expected \{plan\}"),
        ("agent 'open {plan}", "No closing quotation"),
        ("no-such-program-here {plan}", "expected an executable program, got no-such-program-here"),
    ],
)
def test_lines_that_are_no_command(command, message):
    with pytest.raises(ValueError, match=message):
        Command(command)
