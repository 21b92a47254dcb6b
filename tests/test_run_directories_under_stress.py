"""Run directories after kills, on a disk that fills, with lost files, and with two processes at once."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from small import at_each_update, command, resumed, small_trainer

from pirl_rl import checkpoint, load_run, train
from pirl_rl.configuration import load_config
from pirl_rl.errors import RunError
from pirl_rl.lock import locked
from pirl_rl.loggers import CSVLogger, read_metrics
from pirl_rl.run_directory import RunDirectory

RUN = ("+experiment=reach1d", "+debug=default", "env.dt=0.1", "env.substeps=1", "trainer.updates=12", "figures=false")
RUN += (
    "trainer.evaluate_every=6",
    "trainer.checkpoint_every=4",
    "evaluation.during=[exact]",
    "evaluation.final=[exact]",
)


@pytest.fixture
def cli(in_process):
    return in_process(train)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A run that was never interrupted."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    done = command(*RUN, f"hydra.run.dir={folder}", cwd=folder.parent)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def run(finished, tmp_path) -> RunDirectory:
    """A copy of the finished run."""
    return RunDirectory(shutil.copytree(finished, tmp_path / "copy" / "run"))


def same_end(run: RunDirectory, finished: Path) -> bool:
    mine, theirs = (checkpoint.load(RunDirectory(folder).last)["learner"]["loss"] for folder in (run.path, finished))
    return mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)


def test_a_run_without_a_checkpoint_starts_again(run, finished, cli):
    """As a kill leaves it before the first checkpoint: the configuration, and some rows of metrics."""
    shutil.rmtree(run.checkpoints)
    run.summary.unlink()
    lines = run.metrics.read_text().splitlines(keepends=True)
    run.metrics.write_text("".join(lines[:3]))
    code, text = cli(f"resume={run}")
    assert code == 0, text
    assert "no checkpoint yet" in text
    assert run.metrics.read_text() == "".join(lines)
    assert same_end(run, finished)


def test_a_directory_without_a_configuration_is_used(tmp_path, cli):
    folder = tmp_path / "run"
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / ".config.yaml.draft").write_text("half")
    code, text = cli(*RUN, f"hydra.run.dir={folder}")
    assert code == 0, text
    assert load_run(folder).update == 12


@pytest.mark.parametrize("left", ["", "upd", "update,value_mse\n1,0."])
def test_lost_metrics_are_written_with_all_columns(left, run, finished, cli):
    columns = read_metrics(run.metrics).keys()
    run.metrics.write_text(left) if left else run.metrics.unlink()
    code, text = cli(f"resume={run}", "trainer.updates=18")
    assert code == 0, text
    metrics = read_metrics(run.metrics)
    assert metrics.keys() >= columns
    assert metrics["update"].tolist() == [15, 18]
    assert metrics["value_mse"][-1] == metrics["value_mse"][-1]  # not NaN


def test_a_changed_setting_is_told(run, cli):
    code, text = cli(f"resume={run}", "trainer.updates=13")
    assert code == 0, text
    assert "resume: trainer.updates was 12, and is 13 from now on" in text
    assert load_config(run.path).trainer.updates == 13


def test_two_processes_do_not_write_into_one_directory(run, cli):
    before = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
    with locked(run):
        code, text = cli(f"resume={run}", "trainer.updates=13")
    assert code == 1
    assert f"another process writes into this run directory, process {os.getpid()} on " in text
    assert "Traceback" not in text
    assert before == {path: path.read_bytes() for path in before}
    assert not run.holder.exists()
    assert cli(f"resume={run}", "trainer.updates=13")[0] == 0


def test_the_lock_of_a_dead_process_is_taken_over(tmp_path):
    run = RunDirectory(tmp_path / "run")
    program = (
        "import time; from pirl_rl.lock import locked; from pirl_rl.run_directory import RunDirectory\n"
        f"with locked(RunDirectory({str(run)!r})):\n    print('held', flush=True); time.sleep(60)"
    )
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    assert child.stdout.readline() == "held\n"
    with pytest.raises(RunError, match=f"process {child.pid} on "), locked(run):
        pass
    child.kill()
    child.wait()
    with locked(run):
        assert run.holder.read_text().startswith(f"process {os.getpid()} on ")


@pytest.mark.parametrize(("seconds", "saves"), [(0, 1), (1e-9, 12), (1e9, 1)])
def test_checkpoints_come_after_a_time_too(seconds, saves, tmp_path):
    trainer = small_trainer(
        tmp_path, "trainer.updates=12", "trainer.checkpoint_every=0", f"trainer.checkpoint_seconds={seconds}"
    )
    counted = set()
    at_each_update(trainer, lambda k: counted.add(trainer.saved))
    trainer.train()
    counted.add(trainer.saved)
    assert len(counted - {0}) == saves
    assert resumed(tmp_path).update == 12


def test_new_columns_join_the_old_rows(tmp_path):
    logger = CSVLogger()
    logger.open(tmp_path, {})
    logger.log({"update": 1, "loss": 0.5})
    logger.log({"update": 2, "value_mse": 0.25})
    logger.log({"update": 3, "loss": 0.125})
    assert RunDirectory(tmp_path).metrics.read_text().splitlines() == [
        "update,loss,value_mse",
        "1,0.5,",
        "2,,0.25",
        "3,0.125,",
    ]


def limited(size: int, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """A training that cannot write files beyond a size in bytes, as on a full disk."""
    return subprocess.run(
        [sys.executable, "-m", "pirl_rl.train", *arguments],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=120,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
    )


SIZES = random.Random(0).sample(range(500, 200_000), 20)


@pytest.mark.parametrize("size", [60_000, *(pytest.param(size, marks=pytest.mark.slow) for size in SIZES)])
def test_a_full_disk_ends_with_one_line(size, run, tmp_path):
    """A resumed run that cannot write its checkpoint keeps the one before, and a new run leaves one that opens."""
    before = run.last.read_bytes()
    assert len(before) > 60_000
    done = limited(size, f"resume={run}", "trainer.updates=14", cwd=tmp_path)
    assert "Traceback" not in done.stderr
    if done.returncode:
        assert done.stderr.splitlines()[-1].startswith("error: File too large: ")
        assert run.last.read_bytes() == before
    assert not [*run.path.rglob("*.draft")]
    assert load_run(run.path).update >= 12


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(25))
def test_a_killed_run_goes_on_and_ends_as_the_uninterrupted_one(seed, finished, tmp_path):
    """Kills at a random moment, twice in a run, the second while it resumes."""
    moments, folder = random.Random(seed), tmp_path / "run"
    arguments = [*RUN, f"hydra.run.dir={folder}"]
    for _ in range(2):
        child = subprocess.Popen(
            [sys.executable, "-m", "pirl_rl.train", *arguments], cwd=tmp_path, stderr=subprocess.DEVNULL
        )
        time.sleep(moments.uniform(2.0, 9.0))
        child.send_signal(signal.SIGKILL)
        child.wait()
        if RunDirectory(folder).config.exists():
            arguments = [f"resume={folder}"]
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert same_end(RunDirectory(folder), finished)
    assert RunDirectory(folder).metrics.read_text() == RunDirectory(finished).metrics.read_text()


def killed_after(seconds: float, module: str, *arguments: str, cwd: Path) -> None:
    """Start a command, and kill it after a time unless it has ended."""
    child = subprocess.Popen(
        [sys.executable, "-m", module, *arguments], cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    time.sleep(seconds)
    child.send_signal(signal.SIGKILL)
    child.wait()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_a_killed_evaluation_leaves_a_run_that_opens(seed, run, tmp_path):
    """Its file has all metrics or is not there."""
    killed_after(random.Random(seed).uniform(2.0, 8.0), "pirl_rl.evaluate", f"run={run}", cwd=tmp_path)
    assert load_run(run.path).update == 12
    if run.evaluation.exists():
        assert "value_mse" in json.loads(run.evaluation.read_text())
    done = command(f"run={run}", cwd=tmp_path, module="pirl_rl.evaluate")
    assert done.returncode == 0, done.stderr
    assert "value_mse" in json.loads(run.evaluation.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_a_killed_export_leaves_a_folder_that_opens_or_none(seed, run, tmp_path):
    out, line = tmp_path / "out", (f"run={run}", f"out={tmp_path / 'out'}")
    killed_after(random.Random(seed).uniform(2.0, 4.0), "pirl_rl.export", *line, cwd=tmp_path)
    if not out.exists():
        done = command(*line, cwd=tmp_path, module="pirl_rl.export")
        assert done.returncode == 0, done.stderr
    assert load_run(out).update == 12
    assert {path.name for path in tmp_path.iterdir()} == {"copy", "out"}
    assert RunDirectory(out).summary.read_text() == run.summary.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_two_processes_resume_one_directory(seed, finished, tmp_path):
    """One of them goes on, and the other is refused or finds the run at its end; nothing is mixed."""
    folder, moments = tmp_path / "run", random.Random(seed)
    killed_after(moments.uniform(4.0, 7.0), "pirl_rl.train", *RUN, f"hydra.run.dir={folder}", cwd=tmp_path)
    line = [sys.executable, "-m", "pirl_rl.train"]
    line += [f"resume={folder}"] if RunDirectory(folder).config.exists() else [*RUN, f"hydra.run.dir={folder}"]
    both = []
    for _ in range(2):
        both.append(subprocess.Popen(line, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True))
        time.sleep(moments.uniform(0.0, 0.5))
    told = [process.communicate(timeout=120)[1] for process in both]
    assert 0 in [process.returncode for process in both], told
    for process, text in zip(both, told, strict=True):
        assert "Traceback" not in text
        if process.returncode:
            assert "another process writes into this run directory" in text or "expected an empty directory" in text
    assert same_end(RunDirectory(folder), finished)
    assert RunDirectory(folder).metrics.read_text() == RunDirectory(finished).metrics.read_text()


def test_a_start_from_another_method_is_told_in_one_sentence(tmp_path, cli):
    """TD3's critics have the action as an input, those of the default method do not."""
    code, text = cli(*RUN, "evaluation.final=[]", "method=td3", f"hydra.run.dir={tmp_path / 'td3'}")
    assert code == 0, text
    code, text = cli(*RUN, f"start={tmp_path / 'td3'}")
    assert code == 1
    (line,) = [line for line in text.splitlines() if line.startswith("error: ")]
    assert "its critics have weights of the shapes (2, 32, " in line
    assert ", expected (1, 128, " in line
    assert "that run had method=td3 and this one has method=pirl" in line
    assert "Traceback" not in text


def test_a_new_run_refuses_the_directory_of_one_that_has_just_begun(tmp_path, cli):
    """The first process holds the lock and has written nothing else yet; the second must not clean up after it."""
    run = RunDirectory(tmp_path / "run")
    with locked(run):
        code, text = cli(*RUN, f"hydra.run.dir={run}")
        assert run.holder.is_file()
    assert code == 1
    assert "another process writes into this run directory" in text
    assert run.path.is_dir()
