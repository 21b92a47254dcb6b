"""Objects from configuration nodes: what may be built, and that a foreign run directory runs no code."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from small import small_config, small_trainer

from pirl_rl import load_run
from pirl_rl.assembly import make_trainer
from pirl_rl.building import build, resolve
from pirl_rl.configuration import load_config, save_config
from pirl_rl.errors import ConfigError
from pirl_rl.problems import Reach1D
from pirl_rl.run_directory import RunDirectory

MODULE = """
import os
from pirl_rl.problems import Reach1D
class MyProblem(Reach1D):
    pass
def make(horizon: float = 3.0):
    return MyProblem(horizon=horizon)
"""


@pytest.fixture
def my_module(tmp_path, monkeypatch):
    (tmp_path / "my_module.py").write_text(MODULE)
    sys.modules.pop("my_module", None)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("my_module", None)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "pirl_rl.checkpoint.Path",
        "pirl_rl.collectors.os.system",
        "pirl_rl.train._new",
        "pirl_rl.checkpoint.save",
        "pirl_rl.building.resolve",
        "pirl_rl.problems.Reach1D.__init__",
        "pirl_rl.problems.Reach1D.__class__",
        "pirl_rl.problem",
        "pirl_rl",
        "pirl_rl.",
        "pirl_rl_evil.Problem",
        "pirl_rl..os.system",
        "",
    ],
)
def test_only_classes_of_the_package_are_built(target):
    with pytest.raises(ConfigError, match="node"):
        build(OmegaConf.create({"_target_": target, "command": "false"}), "node")


def test_trusted_modules(my_module):
    with pytest.raises(ConfigError, match=r"trust=\[my_module\]"):
        resolve("my_module.MyProblem", "problem")
    assert build(OmegaConf.create({"_target_": "my_module.make", "horizon": "4"}), "p", ["my_module"]).horizon == 4
    with pytest.raises(ConfigError, match=r"my_module\.os"):
        resolve("my_module.os.system", "problem", ["my_module"])
    with pytest.raises(ConfigError, match="not a class defined in"):
        resolve("my_module.os", "problem", ["my_module"])


@pytest.mark.parametrize(
    ("node", "message"),
    [
        ({"low": [0.0], "hgh": [1.0]}, r"box\.hgh: Box has no such argument; expected one of high, low"),
        ({"low": [0.0], "high": [1.0], "_args_": ["x"]}, r"box\._args_"),
        ({"low": [0.0], "high": [1.0], "_partial_": True}, r"box\._partial_"),
        ({"low": [0.0]}, r"box\.high: a value is missing"),
        ({"low": [0.0], "high": "???"}, r"box\.high: a value is missing"),
        ({"low": [0.0], "high": "wide"}, r"box\.high: expected .*float.*got 'wide'"),
        ({"low": [0.0], "high": [-1.0]}, r"box: Box: axis 0 needs finite low < high"),
    ],
)
def test_errors_name_the_key(node, message):
    with pytest.raises(ConfigError, match=message):
        build(OmegaConf.create({"_target_": "pirl_rl.sets.Box", **node}), "box")


def test_what_the_code_gives_the_configuration_cannot():
    node = OmegaConf.create({"_target_": "pirl_rl.networks.Actor", "problem": 1})
    with pytest.raises(ConfigError, match=r"actor\.problem"):
        build(node, "actor", problem=Reach1D())
    with pytest.raises(ConfigError, match="actor: expected settings with a _target_, got 'relu'"):
        build("relu", "actor")


def test_nested_nodes_are_built():
    env = build(small_config("env.num_envs=8", "env.dt=0.5").env, "env", seed=0)
    assert (env.batch_size[0], env.max_steps, type(env.problem)) == (8, 4, Reach1D)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    small_trainer(folder, "trainer.updates=2").train()
    return folder


@pytest.fixture
def edited(run):
    """Rewrites a setting of the run's configuration, for one test."""
    path = RunDirectory(run).config
    before = path.read_text()

    def edit(key: str, value) -> Path:
        config = OmegaConf.create(before)
        OmegaConf.update(config, key, value, force_add=True)
        path.write_text(OmegaConf.to_yaml(config))
        return run

    yield edit
    path.write_text(before)


@pytest.mark.parametrize(
    ("key", "reads"),
    [
        ("env.problem", load_run),
        ("actor", load_run),
        ("critic", load_run),
        ("loss", lambda folder: make_trainer(load_config(folder))),
    ],
)
def test_hostile_run_directory_runs_nothing(key, reads, edited, tmp_path):
    """Reading V builds no loss; training further does."""
    proof = tmp_path / "ran"
    folder = edited(key, {"_target_": "os.system", "command": f"touch {proof}"})
    with pytest.raises(ConfigError, match=r"os\.system"):
        reads(folder)
    assert not proof.exists()


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "a${oc.env:HOME}b", "${now:%Y}", "${${seed}:x}"])
def test_a_run_directory_calls_no_resolver(text, edited):
    with pytest.raises(ConfigError, match="may refer to its own keys only"):
        load_config(edited("experiment_name", text))


def test_a_run_directory_cannot_trust_for_the_user(edited, my_module):
    edited("trust", ["my_module"])
    folder = edited("env.problem._target_", "my_module.MyProblem")
    with pytest.raises(ConfigError, match=r"trust=\[my_module\]"):
        load_run(folder)
    assert type(load_run(folder, trust=("my_module",)).problem).__name__ == "MyProblem"


@pytest.mark.parametrize("text", ["[", "- 1", "\x00", "a: ${"])
def test_unreadable_configurations(text, tmp_path):
    RunDirectory(tmp_path).config.parent.mkdir()
    RunDirectory(tmp_path).config.write_text(text)
    with pytest.raises(ConfigError, match=r"config\.yaml"):
        load_config(tmp_path)


def test_a_value_from_the_environment_is_saved_as_a_value(tmp_path, monkeypatch):
    """A run directory refers to its own keys alone, so that it opens anywhere."""
    monkeypatch.setenv("TASK_ID", "7")
    config = small_config("experiment_name=${oc.env:TASK_ID}")
    save_config(config, tmp_path)
    saved = load_config(tmp_path)
    assert saved.experiment_name == "7"
    kept = OmegaConf.to_container(saved, resolve=False)
    assert kept["critics"] == "${pirl.critics}"  # a reference to an own key stays one
