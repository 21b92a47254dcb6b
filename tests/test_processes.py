"""Processes of an outer loop: they run in parallel, stop with the loop, and none remains."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from small import wait_for

from pirl_rl.configuration import CONF
from pirl_rl.outer_loop.directory import locked
from pirl_rl.outer_loop.processes import Job, Processes


def script(name: str, text: str, folder: Path) -> Job:
    return Job(name, (sys.executable, "-c", f"import os, pathlib, signal, sys, time\n{text}"), folder / f"{name}.log")


def test_processes_run_side_by_side_and_keep_their_output(tmp_path):
    meet = "pathlib.Path('{0}').touch()\nwhile not pathlib.Path('{1}').exists(): time.sleep(0.01)\nprint('met {1}')"
    jobs = [script(a, meet.format(tmp_path / a, tmp_path / b), tmp_path) for a, b in ("xy", "yx")]
    jobs.append(script("z", "sys.exit(3)", tmp_path))
    codes = {}
    Processes(2).run(jobs, lambda one, code: codes.update({one.name: code}))
    assert codes == {"x": 0, "y": 0, "z": 3}
    assert "met" in jobs[0].log.read_text()


def test_no_more_processes_than_allowed(tmp_path):
    alone = f"p = pathlib.Path('{tmp_path / 'busy'}')\np.touch(exist_ok=False)\ntime.sleep(0.05)\np.unlink()"
    codes = []
    Processes(1).run([script(name, alone, tmp_path) for name in "abc"], lambda one, code: codes.append(code))
    assert codes == [0, 0, 0]


def test_an_interrupt_lets_the_others_save(tmp_path):
    save = (
        f"signal.signal(signal.SIGINT, lambda *_: (pathlib.Path('{tmp_path / 'saved'}').touch(), sys.exit(130)))\n"
        f"pathlib.Path('{tmp_path / 'ready'}').touch()\ntime.sleep(60)"
    )
    short = f"while not pathlib.Path('{tmp_path / 'ready'}').exists(): time.sleep(0.01)"

    def ended(one, code):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Processes(2).run([script("long", save, tmp_path), script("short", short, tmp_path)], ended)
    assert (tmp_path / "saved").exists()


def test_a_signal_at_any_moment_is_heard(tmp_path):
    """A signal in the middle of a fork, where an exception would be lost, counts too."""
    sleepers = [script(name, "time.sleep(60)", tmp_path) for name in "abc"]
    once = [lambda: os.kill(os.getpid(), signal.SIGINT)]
    os.register_at_fork(before=lambda: once.pop()() if once else None)
    with pytest.raises(KeyboardInterrupt):
        Processes(3).run(sleepers, lambda one, code: None)
    assert not once
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's death signal is Linux's")
def test_no_child_outlives_a_killed_loop_and_the_lock_waits_for_it(tmp_path):
    text = f"""
import sys
from pathlib import Path
from pirl_rl.outer_loop.directory import locked
from pirl_rl.outer_loop.processes import Job, Processes
with locked(Path({str(tmp_path)!r})) as lock:
    code = "import os, time; open({str(tmp_path / "pid")!r}, 'w').write(str(os.getpid()) + '.'); time.sleep(600)"
    Processes(1, [lock]).run([Job("x", (sys.executable, "-c", code), Path({str(tmp_path / "log")!r}))], print)
"""
    environment = {**os.environ, "PYTHONPATH": str(CONF.parent)}
    loop = subprocess.Popen([sys.executable, "-c", text], env=environment)
    pid = tmp_path / "pid"
    wait_for(lambda: pid.exists() and pid.read_text().endswith("."))
    loop.kill()
    loop.wait()
    with locked(tmp_path):
        assert not Path(f"/proc/{pid.read_text()[:-1]}/cwd").exists()
