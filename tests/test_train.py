"""The command `train`: its runs, the settings that it refuses, and the files that it leaves."""

from __future__ import annotations

import datetime
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from small import QUICK, command, small_config

import pirl_rl
from pirl_rl import load_run, train
from pirl_rl.commands import catalogue
from pirl_rl.commands.train import prepare
from pirl_rl.configuration import CONF, load_config
from pirl_rl.lock import locked
from pirl_rl.loggers import TorchRLLogger
from pirl_rl.machine import read_sessions
from pirl_rl.run_directory import RunDirectory

OWN = """
import torch
from pirl_rl import Box, ReachAvoidProblem

class MyProblem(ReachAvoidProblem):
    horizon = 1.0
    states, controls = Box([-2.0, -1.0], [2.0, 1.0]), Box([-1.0], [1.0])
    def drift(self, x, u):
        return torch.cat([x[..., 1:], u], -1)
    def diffusion(self, x, u):
        return torch.stack([torch.zeros_like(x), torch.ones_like(x)], -1)[..., 1:]
    def target_level(self, x):
        return 1 - x[..., 0]
    def avoid_level(self, x):
        return x[..., 0] + OFFSET
"""
SMALL = ("env.num_envs=32", "collector.frames_per_batch=64", "collector.warmup_frames=64", "figures=false")


def names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.fixture
def cli(in_process):
    return in_process(train)


def only_run(folder: Path) -> Path:
    [run] = folder.glob("runs/*/*")
    return run


# The others differ from these in their physics or stages alone, and the command of the README trains `own`.
TRAINED_BY_DEFAULT = ("drift", "reach1d_paper", "safety1d")
EXPERIMENTS = [
    pytest.param(name, marks=[pytest.mark.slow] * (name not in TRAINED_BY_DEFAULT)) for name in names("experiment")
]


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_trains(experiment, cli, tmp_path, monkeypatch):
    own = ["+debug=drift"] if experiment.startswith("drift") and experiment != "drift3" else ["+debug=default", *SMALL]
    own.append("evaluation.during=[residuals]")  # the others are called at the end
    own.append("figures=true")
    if experiment == "own":
        (tmp_path / "my_module.py").write_text(OWN.replace("OFFSET", "1.5"))
        sys.modules.pop("my_module", None)
        monkeypatch.syspath_prepend(tmp_path)
        own.append("env.problem._target_=my_module.MyProblem")
    code, text = cli(f"+experiment={experiment}", *own)
    assert code == 0, text
    run = only_run(tmp_path)
    summary = json.loads((run / "summary.json").read_text())
    assert summary["updates"] == 20
    assert {"success_rate", "reward", "hjb_sup_loss", "td_loss", "boundary_loss", "calibration_mse"} <= summary.keys()
    assert (run / "figures" / "training.png").is_file()
    opened = load_run(run, trust=("my_module",))
    assert opened.update == 20
    sys.modules.pop("my_module", None)


@pytest.mark.parametrize("method", ["pirl", "grid"])
def test_figures_and_report_can_be_left_out(method, cli, tmp_path):
    settings = ("evaluation.final=[success]", f"method={method}")
    code, text = cli("+experiment=reach1d", "+debug=default", *SMALL, *settings)
    assert code == 0, text
    assert not list(only_run(tmp_path).rglob("*.png"))
    assert not list(only_run(tmp_path).rglob("*.html"))


def test_words_for_false_are_false():
    """Hydra reads them as text, and every text counts as true in Python."""
    words = {"check": "off", "compile": "no", "figures": "Off", "report": "n", "verbose": "off"}
    config = small_config(*(f"{name}={word}" for name, word in words.items()))
    prepare(config, [])
    assert [config[name] for name in words] == [False] * 5
    assert config.learner.compile is False


def test_without_arguments_it_says_what_it_needs(cli, tmp_path):
    code, text = cli()
    assert code == 1
    assert "error: nothing to train was named" in text
    assert all(name in text for name in names("experiment"))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    "setting",
    [f"{group}={name}" for group in ("method", "schedule", "logger") for name in names(group) if name != "own"],
)
def test_every_choice_trains(setting, cli, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_API_KEY", "")
    monkeypatch.setenv("NETRC", str(tmp_path / "absent"))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("WANDB_CACHE_DIR", raising=False)
    code, text = cli(*QUICK, *SMALL, setting)
    assert code == 0, text
    run = only_run(tmp_path)
    # A grid is not trained, so that it has no curves.
    assert (run / "metrics.csv").exists() == (setting not in ("logger=none", "method=grid"))
    assert not (tmp_path / ".cache" / "wandb").exists()
    if setting == "logger=wandb":
        assert list(run.glob("wandb/offline-run-*/*.wandb"))
    if setting == "logger=tensorboard":
        assert list(run.glob("tensorboard/events*"))


def test_a_resumed_run_is_the_same_one_of_weights_and_biases(tmp_path, monkeypatch):
    """The members of a population have ids of their own."""
    for name in ("WANDB_API_KEY", "WANDB_CACHE_DIR"):
        monkeypatch.setenv(name, "")
    monkeypatch.setenv("NETRC", str(tmp_path / "absent"))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("WANDB_MODE", "offline")
    ids = []
    for folder, updates in (("one", 3), ("one", 6), ("other", 3)):
        (tmp_path / folder).mkdir(exist_ok=True)
        logger = TorchRLLogger("wandb")
        logger.open(tmp_path / folder, {"trainer": {"updates": updates}})
        logger.log({"update": updates, "loss": 0.5})
        ids.append(logger.logger.experiment.id)
        logger.close()
    assert ids[0] == ids[1] != ids[2]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["trainer.updats=3"], "updats"),
        (["+trainer.updats=3"], "trainer.updats"),
        (["trainer.updates=many"], "trainer.updates: expected int, got 'many'"),
        (["trainer.updates=-3"], "trainer.updates: expected an integer >= 1, got -3"),
        (["env.dt=5"], "dt: expected 0 < dt <= horizon = 2.0, got 5.0"),
        (["seed=x"], "seed: expected int, got 'x'"),
        (["seed=-1"], "seed"),
        (["critics=0"], "critics"),
        (["device=cuda"], "device"),
        (["device=tpu"], "device: expected auto, cpu or cuda"),
        (["compile=maybe"], "compile: expected bool, got 'maybe'"),
        (["figures=perhaps"], "figures: expected bool, got 'perhaps'"),
        (["logger._target_=os.system"], "logger._target_"),
        (["loss=td3"], "loss: expected settings with a _target_, got 'td3'"),
        (["critic.activation=Tnah"], "Tnah"),
        (["evaluation.final=[exact,nope]"], "evaluation.final"),
        (["method=nope"], "nope"),
        (["collector=nope"], "nope"),
        (["env.problem._target_=nope.Problem"], "nope"),
        (["env.problem._target_=pirl_rl.problems.Nope"], "Nope"),
        (["env.num_envs=0"], "num_envs"),
        (["hydra.run.dir=."], "not empty"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_mistakes_are_named_and_leave_nothing(arguments, told, cli, tmp_path):
    (tmp_path / "mine").touch()
    if "device=cuda" in arguments and torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    code, text = cli(*QUICK, *arguments)
    assert code == 1
    assert told in text
    assert "Traceback" not in text
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("folder", ["run", "runs/deep/run"])
def test_a_mistake_does_not_remove_the_current_directory(folder, cli, tmp_path):
    code, text = cli(*QUICK, f"hydra.run.dir={folder}", "trainer.updates=-1")
    assert code == 1
    assert "trainer.updates" in text
    assert tmp_path.is_dir()
    assert not [*tmp_path.iterdir()]


def test_a_mistake_leaves_folders_elsewhere(cli, tmp_path_factory):
    """The run's own folder goes, and an empty one above it that is not below the current directory stays."""
    mine = tmp_path_factory.mktemp("elsewhere") / "mine"
    mine.mkdir()
    code, _ = cli(*QUICK, f"hydra.run.dir={mine / 'run'}", "trainer.updates=-1")
    assert code == 1
    assert mine.is_dir()
    assert not [*mine.iterdir()]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["+experiment=nope"], "nope"),
        (["+experiment=own"], "env.problem._target_: a value is missing"),
        (["resume=nope"], "nope is not a run directory"),
        (["resume=."], ". is not a run directory"),
        (
            ["resume=a", "resume=b"],
            "resume=RUN_DIR once, the directory of a run to resume, got a and b",
        ),
        (["+experiment=own", "env.problem._target_=drowned.MyProblem"], "expected a target outside"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_mistakes_of_whole_runs(arguments, told, cli, tmp_path, monkeypatch):
    (tmp_path / "drowned.py").write_text(OWN.replace("OFFSET", "-9"))
    monkeypatch.syspath_prepend(tmp_path)
    code, text = cli(*arguments)
    sys.modules.pop("drowned", None)
    assert code == 1
    assert told in text
    assert "x = [" in text or "outside" not in told
    assert "Traceback" not in text
    assert not (tmp_path / "runs").exists()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    done = command(*QUICK, *SMALL, "learner.decay=constant", "trainer.updates=10", cwd=folder)
    assert done.returncode == 0, done.stderr
    return only_run(folder)


def test_resume_with_more_updates(finished, cli, tmp_path):
    code, text = cli(f"resume={finished}", "trainer.updates=14")
    assert code == 0, text
    assert load_config(finished).trainer.updates == 14
    assert json.loads((finished / "summary.json").read_text())["updates"] == 14
    assert load_run(finished).update == 14
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("trainer.updates=2", "trainer.updates"),
        ("trainer.updats=20", "updats"),
        ("logger=none", "single settings only"),
        ("+seed=1", "single settings only"),
        ("-m", "-m"),
        ("trainer.updates=[", "["),
        ("critic.hidden=[8]", "does not fit"),
        ("seed=5", "seed=5: a run goes on with the random numbers of its checkpoint, expected the seed "),
    ],
)
def test_resume_refuses(override, told, finished, cli):
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    code, text = cli(f"resume={finished}", override)
    assert code == 1
    assert told in text
    assert "Traceback" not in text
    assert "from now on" not in text
    assert before == {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}


def test_resume_writes_nowhere_else(finished, cli, tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    link = finished / "figures" / "extra.png"
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(precious)
    code, text = cli(f"resume={finished}")
    link.unlink()
    assert (code, precious.read_text()) == (1, "mine")
    assert "leads out of the run directory" in text


def test_resume_ignores_what_the_directory_trusts(finished, cli):
    path, before = RunDirectory(finished).config, RunDirectory(finished).config.read_text()
    hostile = OmegaConf.create(before)
    hostile.trust = ["os"]
    hostile.logger = {"_target_": "os.system", "command": "touch ran"}
    path.write_text(OmegaConf.to_yaml(hostile))
    code, text = cli(f"resume={finished}")
    path.write_text(before)
    assert code == 1
    assert "os.system is outside pirl_rl" in text
    assert not Path("ran").exists()


def test_a_run_is_never_overwritten(finished, cli):
    before = RunDirectory(finished).config.read_bytes()
    code, text = cli(*QUICK, "seed=5", f"hydra.run.dir={finished}")
    assert code == 1
    assert "no run overwrites files" in text
    assert RunDirectory(finished).config.read_bytes() == before


def test_runs_that_begin_in_the_same_second_have_directories_of_their_own(cli, tmp_path, monkeypatch):
    """On the command line and from Python, also where the first of them still runs; a refused one leaves nothing."""

    class Stopped(datetime.datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 31, 12)

    monkeypatch.setattr("hydra.core.utils.datetime", Stopped)
    few = (*QUICK, *SMALL, "trainer.updates=3", "report=false", "evaluation.during=[]")
    running = tmp_path / "runs" / "reach1d" / "2026-01-31_12-00-00-0"
    with locked(RunDirectory(running)):
        assert cli(*few, "trainer.updates=-1")[0] == 1
        code, text = cli(*few)
        assert code == 0, text
    settings = {"updates": 3, "debug": "default", "env.num_envs": 32, "report": False, "figures": False}
    pirl_rl.train("reach1d", **settings, **{"evaluation.during": [], "evaluation.final": []})
    assert sorted(path.name for path in running.parent.iterdir()) == [
        running.name,
        f"{running.name}-2",
        f"{running.name}-3",
    ]
    assert not RunDirectory(running).config.exists()
    assert [load_run(f"{running}-{number}").update for number in (2, 3)] == [3, 3]


def test_sweep_goes_on_after_a_bad_job(cli, tmp_path):
    code, text = cli("-m", *QUICK, *SMALL, "seed=0,x,2")
    assert code == 1
    assert "seed: expected int, got 'x'" in text
    assert "Traceback" not in text
    assert sorted(path.name for path in tmp_path.glob("runs/*/*/*-*")) == ["0-pirl-0", "2-pirl-2"]


def test_a_sweep_that_is_started_again_repeats_nothing(cli, tmp_path):
    """At the second start, the first run is finished and the second was begun."""
    sweep = ("-m", *QUICK, *SMALL, "hydra.sweep.dir=sweep", "evaluation.during=[]")
    assert cli(*sweep, "seed=0,1")[0] == 0
    finished, begun = (RunDirectory(tmp_path / "sweep" / f"{seed}-pirl-{seed}") for seed in range(2))
    begun.summary.unlink()
    before = {path: path.stat().st_mtime_ns for path in finished.path.rglob("*")}
    code, text = cli(*sweep, "seed=0,1")
    assert code == 0, text
    assert text.count("is finished already") == 1
    assert {path: path.stat().st_mtime_ns for path in finished.path.rglob("*")} == before
    assert begun.numbers()["updates"] == finished.numbers()["updates"]
    assert [len(read_sessions(run)) for run in (finished, begun)] == [1, 2]
    code, text = cli(*sweep, "method=pirl", "seed=0,1")
    assert code == 1
    assert "expected a new directory, or that of runs with the same settings" in text
    assert {path: path.stat().st_mtime_ns for path in finished.path.rglob("*")} == before


def test_bad_sweep_leaves_nothing(tmp_path):
    done = command("-m", *QUICK, "method=nope,pirl", cwd=tmp_path)
    assert done.returncode == 1
    assert "nope" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_joblib_sweep(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    arguments = ["-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", *QUICK, *SMALL]
    done = command(*arguments, "seed=0,1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("runs/*/*/*/summary.json"))) == 2
    done = command(*arguments, "seed=0,x", cwd=tmp_path)
    assert done.returncode == 1
    assert "seed: expected int, got 'x'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment",
    [pytest.param({"PATH": "", "CXX": ""}, id="none"), pytest.param({"CXX": "false"}, id="broken")],
)
def test_without_a_compiler_it_warns_once_and_trains(environment, tmp_path):
    cache = {"TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache"), "TMPDIR": str(tmp_path)}
    done = command(*QUICK, *SMALL, "compile=true", cwd=tmp_path, **environment, **cache)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("updates run eagerly") == 1
    assert (only_run(tmp_path) / "summary.json").exists()


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    """Start a training without end, and return after its first row of metrics."""
    environment = {**os.environ, "PYTHONPATH": str(CONF.parent), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "pirl_rl.train", *QUICK, *SMALL, "trainer.updates=1000000", *arguments]
    child = subprocess.Popen(line, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True)
    for text in child.stderr:
        if text.startswith("update 1/"):
            return child
    raise AssertionError("training ended before its first update")


@pytest.mark.parametrize("collector", ["sync", pytest.param("multi_async", marks=pytest.mark.slow)])
def test_interrupt_saves_and_tells_how_to_go_on(collector, cli, tmp_path):
    child = start(tmp_path, f"collector={collector}", *SMALL[1:])
    child.send_signal(signal.SIGINT)
    text = child.communicate(timeout=60)[1]
    assert child.returncode == 130
    assert "resume with: python -m pirl_rl.train resume=" in text
    assert "Traceback" not in text
    run = only_run(tmp_path)
    assert load_run(run).update >= 1
    code, text = cli(f"resume={run}", f"trainer.updates={load_run(run).update + 1}")
    assert code == 0, text


@pytest.mark.slow
def test_installed_wheel_in_an_empty_directory(tmp_path):
    root, wheels, site = CONF.parent, tmp_path / "wheels", tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", str(wheels), str(root)], check=True)
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), *map(str, wheels.glob("*.whl"))], check=True)
    empty = tmp_path / "empty"
    empty.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"}
    for arguments in (["pirl_rl"], ["pirl_rl.train", *QUICK, *SMALL]):
        line = [sys.executable, "-m", *arguments]
        done = subprocess.run(line, cwd=empty, env=environment, capture_output=True, text=True, timeout=200)
        assert done.returncode == 0, done.stderr
    assert (site / "pirl_rl" / "conf" / "train.yaml").is_file()
    assert (only_run(empty) / "summary.json").is_file()


def test_catalogue_lists_what_there_is():
    text = catalogue.catalogue()
    for group in catalogue.GROUPS:
        for name in names(group):
            lines = [line for line in text.splitlines() if line.split()[:1] == [name]]
            assert lines
            assert all(len(line.split()) > 2 for line in lines), (
                f"conf/{group}/{name}.yaml needs a comment that says what it is"
            )
    assert "Reach1D" in text
