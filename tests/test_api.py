"""The Python interface: equal runs to those of the command line, and the methods of a run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from small import command

import pirl_rl
from pirl_rl import api
from pirl_rl.commands.settings import compose_run
from pirl_rl.errors import ArgumentError, ConfigError, Interrupted
from pirl_rl.problems import Reach1D
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs import run as runs

SETTINGS = {
    "updates": 12,
    "seed": 3,
    "compile": False,
    "debug": "default",
    "figures": False,
    "evaluation": {"during": ["exact"], "final": ["success"]},
    "env.num_envs": 32,
    "collector": {"frames_per_batch": 64, "warmup_frames": 64},
}
TYPED = ("trainer.updates=12", "seed=3", "compile=false", "+debug=default", "evaluation.during=[exact]")
TYPED += (
    "evaluation.final=[success]",
    "env.num_envs=32",
    "collector.frames_per_batch=64",
    "collector.warmup_frames=64",
)


class Slower(Reach1D):
    """One that no other process can import by its module's name in a configuration without trust."""


class Windy(Reach1D):
    """One with an argument."""

    def __init__(self, wind: float = 0.0):
        super().__init__()
        self.wind = wind


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("api") / "run"
    return folder, pirl_rl.train("reach1d", folder=folder, **{**SETTINGS, "figures": True})


def test_python_and_the_command_line_train_the_same_run(run, tmp_path):
    done = command("+experiment=reach1d", *TYPED, "hydra.run.dir=typed", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    ours, typed = RunDirectory(run[0]), RunDirectory(tmp_path / "typed")
    assert ours.metrics.read_bytes() == typed.metrics.read_bytes()
    numbers = [json.loads(one.summary.read_text()) for one in (ours, typed)]
    for name in numbers[0].keys() - {"wall_seconds", "updates_per_second"}:
        assert numbers[0][name] == numbers[1][name]
    assert ours.config.read_text() == typed.config.read_text()
    assert {path.name for path in ours.figures.iterdir()} == {path.name for path in typed.figures.iterdir()}


def test_the_run_comes_back_open(run):
    folder, opened = run
    again = pirl_rl.load_run(folder)
    x = np.linspace(-2, 2, 9)[:, None]
    assert (opened.update, again.update) == (12, 12)
    for name in ("value", "gradient", "residual", "policy"):
        ours, theirs = (getattr(one, name)(1.0, x) for one in (opened, again))
        assert isinstance(ours, np.ndarray)
        assert np.array_equal(ours, theirs)
        assert np.array_equal(getattr(opened, name)(1.0, torch.as_tensor(x)).numpy(), ours)
        assert ours.shape == ((9, 1) if name in ("gradient", "policy") else (9,))


@pytest.mark.parametrize("name", ["value", "residual", "gradient", "policy"])
def test_a_single_state_has_the_result_of_a_row(name, run):
    one, row = (getattr(run[1], name)(1.0, x) for x in (np.array([0.3]), np.array([[0.3]])))
    assert one.shape == row.shape[1:]
    assert np.array_equal(one, row[0])
    assert run[1].reach_avoid_set(0.5, 1.0)([0.3]).shape == ()


@pytest.mark.parametrize("name", ["value", "residual", "gradient", "policy"])
def test_many_states_are_evaluated_in_parts(name, run, monkeypatch):
    x = np.linspace(-2, 2, 101).reshape(1, 101, 1)
    whole = getattr(run[1], name)(1.0, x)
    rows, function = [], getattr(run[1].solution, name)

    def counted(tau, x):
        rows.append(len(x))
        return function(tau, x)

    monkeypatch.setattr(runs, "AT_ONCE", 40)
    monkeypatch.setattr(run[1].solution, name, counted)
    parts = getattr(run[1], name)(1.0, x)
    assert rows == [40, 40, 21]
    assert parts.shape == whole.shape
    np.testing.assert_allclose(parts, whole, rtol=1e-5, atol=1e-6)
    assert getattr(run[1], name)(1.0, x[:, :0]).shape[:2] == (1, 0)


def test_gradient_is_the_slope_of_the_value(run):
    x, h = np.linspace(-1.5, 1.5, 7)[:, None], 1e-2
    value = run[1].solution.raw_value
    slope = [value(torch.ones(7), torch.as_tensor(x + sign * h, dtype=torch.float32)) for sign in (1, -1)]
    expected = (slope[0] - slope[1]).numpy() / (2 * h)
    # Single precision: rounding 1e-7 / h beside the curvature's h^2.
    assert run[1].gradient(1.0, x)[:, 0] == pytest.approx(expected, abs=1e-3)


def test_a_run_simulates_what_it_was_trained_on(tmp_path):
    settings = {**SETTINGS, "env": {"dt": 0.05, "substeps": 2, "crossing": "endpoint", "num_envs": 32}}
    del settings["env.num_envs"]
    one = pirl_rl.train("reach1d", folder=tmp_path / "run", **settings)
    simulator = one.simulator
    assert (simulator.dt, simulator.substeps, simulator.crossing) == (0.05, 2, "endpoint")
    x = np.zeros((4, 1))
    assert len(one.simulate(1.0, x).tau) == 21
    assert len(one.simulate(1.0, x, dt=0.1).tau) == 11
    steps = {"dt": 0.05, "substeps": 2, "crossing": "endpoint"}
    ours = one.monte_carlo(1.0, x, rollouts=64)
    theirs = pirl_rl.monte_carlo(one.problem, one.solution.policy, 1.0, x, rollouts=64, **steps)
    assert np.array_equal(ours.probability, theirs.probability)
    other = pirl_rl.monte_carlo(one.problem, one.solution.policy, 1.0, x, rollouts=64, **{**steps, "dt": 0.1})
    assert np.array_equal(one.monte_carlo(1.0, x, rollouts=64, dt=0.1).probability, other.probability)


@pytest.mark.parametrize(
    ("tau", "x", "message"),
    [
        (1.0, np.zeros(3), r"x: expected states of shape \(\*, 1\), got \(3,\)"),
        (1.0, np.zeros((3, 2)), r"x: expected states of shape \(\*, 1\), got \(3, 2\)"),
        (1.0, np.full((3, 1), np.nan), "finite"),
        (np.ones(2), np.zeros((3, 1)), r"tau: expected a number or the shape \(3,\) of the states, got \(2,\)"),
        (2.1, np.zeros((3, 1)), "0 <= tau <= horizon = 2"),
        (-0.1, np.zeros((3, 1)), "0 <= tau"),
        (np.nan, np.zeros((3, 1)), "0 <= tau"),
    ],
)
def test_wrong_arguments_are_named(tau, x, message, run):
    for method in (run[1].value, run[1].gradient, run[1].simulate, run[1].monte_carlo):
        with pytest.raises(ArgumentError, match=message):
            method(tau, x)


def test_an_object_is_trained_and_given_again_to_open_its_run(tmp_path):
    problem = Reach1D(horizon=1.0)
    trained = pirl_rl.train(problem, folder=tmp_path / "run", **SETTINGS)
    assert trained.problem is problem
    with pytest.raises(ConfigError, match=r"env\.problem\._target_: a value is missing.*load_run\(folder, problem="):
        pirl_rl.load_run(tmp_path / "run")
    again = pirl_rl.load_run(tmp_path / "run", problem=problem)
    x = np.zeros((3, 1))
    assert np.array_equal(trained.value(1.0, x), again.value(1.0, x))
    assert pirl_rl.evaluate(again)["success_rate"] == pirl_rl.evaluate(trained)["success_rate"]


def test_a_run_of_an_object_goes_on_with_the_object(in_process, tmp_path):
    """It ends as a run that was not interrupted; the command line says what to do in place of it."""
    problem = Reach1D(horizon=1.0)
    settings = {**SETTINGS, "learner.decay": "constant"}
    whole = pirl_rl.train(problem, folder=tmp_path / "whole", **settings)
    pirl_rl.train(problem, folder=tmp_path / "cut", **{**settings, "updates": 6})
    code, text = in_process(pirl_rl.train)(f"resume={tmp_path / 'cut'}")
    assert code == 1
    assert "pirl_rl.train(problem, resume=folder)" in text
    again = pirl_rl.train(problem, resume=tmp_path / "cut", updates=12)
    assert again.update == 12
    assert again.problem is problem
    x = np.linspace(-2, 2, 9)[:, None]
    assert np.array_equal(again.value(0.5, x), whole.value(0.5, x))
    with pytest.raises(ConfigError, match="updats: expected one of"):
        pirl_rl.train(problem, resume=tmp_path / "cut", updats=14)
    with pytest.raises(ConfigError, match="resume: expected a problem, and no folder"):
        pirl_rl.train(problem, resume=tmp_path / "cut", folder=tmp_path / "other")


def test_a_population_of_an_object_goes_on_with_the_object(tmp_path):
    problem, settings = Reach1D(horizon=1.0), dict(SETTINGS)
    del settings["seed"]
    pirl_rl.train(problem, folder=tmp_path / "out", seeds=[0, 1], **settings)
    runs = pirl_rl.train(problem, resume=tmp_path / "out")
    assert [run.update for run in runs] == [12, 12]
    assert all(run.problem is problem for run in runs)


def test_a_class_that_only_this_process_has_is_trained(tmp_path):
    class Here(Reach1D):
        pass

    trained = pirl_rl.train(Here, folder=tmp_path / "run", **SETTINGS)
    assert type(trained.problem) is Here


def test_a_class_that_can_be_imported_is_named_by_the_configuration(tmp_path):
    trained = pirl_rl.train(Slower, folder=tmp_path / "run", **SETTINGS)
    assert trained.config.env.problem._target_ == f"{__name__}.Slower"
    for trust in ((__name__,), __name__):
        assert type(pirl_rl.load_run(tmp_path / "run", trust=trust).problem) is Slower
    with pytest.raises(ConfigError, match=rf"trust=\[{__name__}\]"):
        pirl_rl.load_run(tmp_path / "run")


def test_a_class_takes_its_arguments_from_the_settings(tmp_path):
    """By keys with dots or by a nested mapping, also those that the configuration does not have."""
    few = {**SETTINGS, "updates": 2}
    run = pirl_rl.train(Windy, folder=tmp_path / "run", **few, **{"env.problem.wind": -0.25})
    assert run.problem.wind == -0.25
    nested = {"env.problem._target_": "my_module.MyProblem", "env": {"problem": {"wind": -0.25}}}
    assert compose_run("own", nested)[0].env.problem.wind == -0.25
    assert run.config.env.problem.wind == -0.25
    with pytest.raises(ConfigError, match=r"env\.problem\.wnd: Windy has no such argument; expected one of wind"):
        pirl_rl.train(Windy, folder=tmp_path / "other", **few, **{"env.problem.wnd": 1.0})


@pytest.mark.parametrize("value", [0.0, {"a": [1, "b c"]}], ids=str)
def test_a_plus_sign_adds_an_argument_as_on_the_command_line(value):
    config, typed = compose_run("reach1d", {"+pirl.actor_rule.hold": value})
    assert config.pirl.actor_rule.hold == value
    assert typed[-1].startswith("+pirl.actor_rule.hold=")
    assert compose_run("reach1d", {"++updates": 7})[0].trainer.updates == 7


@pytest.mark.parametrize("settings", [{"env.problem.horizon": 1.0}, {"env": {"problem": {"horizon": 1.0}}}], ids=str)
def test_arguments_of_an_object_are_refused_with_what_to_do(settings, tmp_path):
    message = r"env\.problem.*: expected no arguments of the problem, which is an object of Reach1D.*give them to "
    with pytest.raises(ConfigError, match=message):
        pirl_rl.train(Reach1D(), folder=tmp_path / "run", **settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"updats": 3}, "updats: expected one of .*method.*updates"),
        ({"schedule.centre": 3}, r"schedule\.centre: expected one of .*center"),
        ({"schedule": {"centre": 3}}, r"schedule\.centre: expected one of .*center"),
        ({"seed": {"a": 1}}, r"seed\.a: expected one of no more names"),
        (
            {"pirl.actor_rule.hold": 0.0},
            r"expected one of _target_; '\+pirl\.actor_rule\.hold' adds an argument to pirl",
        ),
        ({"+pirl.actor_rule.hodl": 0.0}, r"hodl: BestControl has no such argument; expected one of .*hold"),
        ({"+seed": 1}, r"Could not append to config\. An item is already at 'seed'"),
        ({"+updates": 1}, r"Could not append to config\. An item is already at 'trainer\.updates'"),
        ({"+nothing.here": 1}, r"\+nothing\.here: expected one of .*method"),
        ({"method": "nope"}, "nope"),
        ({"updates": "many"}, "trainer.updates: expected int, got 'many'"),
        ({"updates": slice(3)}, "trainer.updates: expected a number, text"),
        ({"resume": "run"}, "resume"),
        ({"collocation": {"_target_": "pirl_rl.sampling.collocation.Collocation", "sise": 3}}, "sise"),
    ],
    ids=str,
)
def test_unknown_settings_are_named_and_leave_nothing(settings, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=message):
        pirl_rl.train("reach1d", **settings)
    assert not list(tmp_path.iterdir())


def test_what_is_no_problem_is_refused():
    with pytest.raises(ArgumentError, match="got int"):
        pirl_rl.train(3)
    with pytest.raises(ArgumentError, match=r"ReachAvoidProblem lacks diffusion, drift"):
        pirl_rl.train(pirl_rl.ReachAvoidProblem)


@pytest.mark.parametrize(
    "value",
    ["a, b", "it's", "null", "3", "", "x=[y]", "${oc.env:HOME}x", "C:\\", Path("/a b/c"), [1, "a b", None], 1e-5, True],
    ids=str,
)
def test_any_value_reaches_the_configuration(value):
    config, _ = compose_run("reach1d", {"start": value})
    found = config._get_node("start")
    found = list(found) if isinstance(value, list) else found._value()
    assert found == (str(value) if isinstance(value, Path) else value)


def test_evaluate_takes_other_samples(run):
    before = pirl_rl.evaluate(run[1])
    summary = json.loads(RunDirectory(run[0]).summary.read_text())
    assert before == {name: summary[name] for name in before}
    after = pirl_rl.evaluate(run[0], final=["success", "exact"], success={"episodes": 2000})
    assert "value_mse" in after
    assert after["success_high"] - after["success_low"] < before["success_high"] - before["success_low"]
    with pytest.raises(ConfigError, match="episods"):
        pirl_rl.evaluate(run[1], success={"episods": 2000})


# Imports


def python(text: str) -> str:
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_package_itself_imports_nothing_heavy():
    heavy = ("torch", "torchrl", "tensordict", "numpy", "hydra", "omegaconf", "matplotlib", "wandb")
    assert python(f"import sys, pirl_rl; print([name for name in {heavy} if name in sys.modules])") == "[]\n"


def test_training_itself_knows_no_hydra_and_its_command_waits_for_no_figures():
    names, slow = ("hydra", "omegaconf", "wandb", "pirl_rl.configuration"), ("matplotlib", "plotly", "scipy.stats")
    text = f"import sys, pirl_rl.trainer, pirl_rl.loggers; print([name for name in {names} if name in sys.modules]); "
    text += f"import pirl_rl.api, pirl_rl.commands.train; print([name for name in {slow} if name in sys.modules])"
    assert python(text) == "[]\n[]\n"


@pytest.mark.parametrize(
    "first", ["import pirl_rl", "import pirl_rl.train, pirl_rl.evaluate", "import pirl_rl.api", "pirl_rl.train"]
)
def test_commands_and_functions_of_one_name(first):
    """Whichever is imported first, `pirl_rl.train` is the command's module and can be called."""
    first = "import pirl_rl; pirl_rl.train; pirl_rl.evaluate" if first == "pirl_rl.train" else first
    text = "; from pirl_rl import train, evaluate; import pirl_rl.train, pirl_rl.evaluate; "
    text += "print(*(one.__name__ for one in (train, evaluate) if callable(one) and callable(one.main)), "
    text += "pirl_rl.train is train and pirl_rl.evaluate is evaluate)"
    assert python(first + text) == "pirl_rl.train pirl_rl.evaluate True\n"


def test_every_exported_name_is_there():
    for name in pirl_rl.__all__:
        assert getattr(pirl_rl, name) is not None
    assert {*pirl_rl.__all__} <= {*dir(pirl_rl)}
    with pytest.raises(AttributeError, match="nope"):
        _ = pirl_rl.nope


def test_a_training_that_is_stopped_names_its_directory(tmp_path, monkeypatch):
    def stopped(*arguments):
        raise Interrupted(7)

    monkeypatch.setattr(api, "train_new", stopped)
    with pytest.raises(Interrupted, match=r"stopped at update 7; the run in .*run can be resumed") as caught:
        pirl_rl.train("reach1d", folder=tmp_path / "run", **SETTINGS)
    assert caught.value.update == 7
