"""Inputs that make no sense: each is refused in one sentence, without a traceback, and no file is lost or half written.

The three tables are calls of the Python interface, command lines, and files of a run directory that were spoilt.
"""

from __future__ import annotations

import math
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import pirl_rl
from pirl_rl import certify, check, compare, evaluate, export, suite, train, tune
from pirl_rl.errors import PirlError
from pirl_rl.problems import ZermeloBoat
from pirl_rl.run_directory import RunDirectory

X = [[0.2], [0.5]]
SHORE = torch.tensor([[-0.8, 0.3], [-0.6, -0.2]])
"""States of the boat outside both sets."""

NAN = float("nan")

OWN = """
import torch

import pirl_rl


class Own(pirl_rl.ReachAvoidProblem):
    states = pirl_rl.Box([-1, -1], [1, 1])
    controls = pirl_rl.Box([-1], [1])
    horizon = 1.0

    def drift(self, x, u):
        return torch.stack([x[..., 1], u[..., 0]], -1)

    def diffusion(self, x, u):
        return 0.3 * torch.eye(2).to(x).expand(*x.shape[:-1], 2, 2)

    def target_level(self, x):
        return x.norm(dim=-1) - 0.3


class NanDrift(Own):
    def drift(self, x, u):
        return super().drift(x, u) * float("nan")


class Raises(Own):
    def drift(self, x, u):
        raise KeyError("speed")


class Endless(Own):
    horizon = float("inf")


class Beyond(Own):
    def target_level(self, x):
        return (x - 5).norm(dim=-1) - 0.1


class Integers(Own):
    def drift(self, x, u):
        return super().drift(x, u).int()


class NoMap(Own):
    def __init__(self):
        raise ValueError("no map.png")


class Abstract(pirl_rl.ReachAvoidProblem):
    states, controls, horizon = Own.states, Own.controls, 1.0
"""


class Windy(ZermeloBoat):
    def __init__(self, wind, size=torch.abs):
        super().__init__()
        self.wind, self.size = wind, size

    def drift(self, x, u):
        return super().drift(x, u) + self.wind(x)

    def avoid_constraints(self, x):
        return 2 - self.size(x)


class Planes(Windy):
    def planes(self):
        return {}


class Exact(Windy):
    def exact_value(self, tau, x):
        return np.ones(len(x))


def sail(policy, tau=1.0, x=SHORE, **settings):
    return pirl_rl.monte_carlo(ZermeloBoat(), policy, tau, x, rollouts=4, dt=0.1, **settings)


CALLS = {
    "tau beyond the horizon": (lambda run: run.value(3.0, X), r"tau: expected 0 <= tau <= horizon = 2.0 s, got 3.0"),
    "negative tau": (lambda run: run.value(-1, X), "tau: expected 0 <= tau"),
    "tau is not a number": (lambda run: run.gradient(NAN, X), "tau: expected 0 <= tau"),
    "tau is text": (lambda run: run.policy("two", X), "tau: expected numbers, got str"),
    "tau of another shape": (
        lambda run: run.residual([0.1, 0.2, 0.3], X),
        r"tau: expected a number or the shape \(2,\)",
    ),
    "x is not a number": (lambda run: run.value(1, [[NAN]]), "x: expected finite states"),
    "infinite x": (lambda run: run.policy(1, [[math.inf]]), "x: expected finite states"),
    "x of another dimension": (
        lambda run: run.value(1, [[1, 2]]),
        r"x: expected states of shape \(\*, 1\), got \(1, 2\)",
    ),
    "scalar x": (lambda run: run.value(1, 0.5), r"x: expected states of shape \(\*, 1\), got \(\)"),
    "ragged x": (lambda run: run.value(1, [[0.1], [0.2, 0.3]]), "x: expected numbers, got list"),
    "complex x": (lambda run: run.value(1, np.array([[1j]])), "x: expected real numbers"),
    "negative look-ahead": (lambda run: run.policy(1, X, lookahead=-1), "lookahead >= 0"),
    "one level": (lambda run: run.policy(1, X, lookahead=1, levels=1), "levels >= 2"),
    "set of negative tau": (lambda run: run.reach_avoid_set(0.5, tau=-3), "tau: expected 0 <= tau"),
    "set of p above 1": (
        lambda run: run.reach_avoid_set(1.5, tau=1),
        r"p: expected a probability in \[0, 1\], got 1.5",
    ),
    "set of p not a number": (lambda run: run.reach_avoid_set(NAN, tau=1), "p: expected a probability"),
    "no time step": (lambda run: run.simulate(1, X, dt=0), "dt: expected 0 < dt <= horizon"),
    "time step of text": (lambda run: run.simulate(1, X, dt="a"), "dt: expected 0 < dt <= horizon = 2.0, got 'a'"),
    "time step beyond the horizon": (lambda run: run.simulate(1, X, dt=1e9), "dt: expected 0 < dt <= horizon"),
    "half a sub-step": (lambda run: run.simulate(1, X, substeps=0.5), "substeps: expected an integer >= 1"),
    "unknown crossing": (lambda run: run.simulate(1, X, crossing="leap"), "crossing: expected 'bridge' or 'endpoint'"),
    "seed of text": (lambda run: run.simulate(1, X, seed="a"), "seed: expected an integer, got 'a'"),
    "start that is no row": (lambda run: run.simulate(1, [0.2]), r"x: expected states of shape \(N, 1\), got \(1,\)"),
    "no rollouts": (lambda run: run.monte_carlo(1, X, rollouts=0), "rollouts: expected an integer >= 1"),
    "half a rollout": (lambda run: run.monte_carlo(1, X, rollouts=1.5), "rollouts: expected an integer >= 1"),
    "confidence in per cent": (lambda run: run.monte_carlo(1, X, confidence=95), "0 < confidence < 1"),
    "confidence of text": (lambda run: run.monte_carlo(1, X, confidence="95%"), "0 < confidence < 1"),
    "no policy": (lambda run: sail(None), "policy: expected a function"),
    "policy with one control of two": (lambda run: sail(lambda tau, x: x[:, :1]), r"got \(8, 1\)"),
    "policy outside its box": (lambda run: sail(lambda tau, x: 100 + x), r"policy: expected controls in Box"),
    "policy that is not a number": (lambda run: sail(lambda tau, x: NAN * x), "policy: expected controls in Box"),
    "policy in numpy": (lambda run: sail(lambda tau, x: x.numpy()), "policy: expected controls as a tensor"),
    "evaluation without episodes": (
        lambda run: pirl_rl.evaluate(run, final=["success"], success={"episodes": 0}),
        "episodes >= 1, got 0",
    ),
    "evaluation of nothing known": (lambda run: pirl_rl.evaluate(run, final=["luck"]), "expected a list of names"),
    "evaluation of a number": (
        lambda run: pirl_rl.evaluate(42),
        "folder: expected the path of a run directory, got 42",
    ),
    "run that is not there": (lambda run: pirl_rl.load_run("nowhere"), "nowhere is not a run directory"),
    "run of another problem": (lambda run: pirl_rl.load_run(run.folder, problem=ZermeloBoat()), "does not fit"),
    "run of a problem's name": (
        lambda run: pirl_rl.load_run(run.folder, problem="boat"),
        "problem: expected an object",
    ),
    "weights outside the run": (lambda run: pirl_rl.load_run(run.folder, weights="../last.pt"), "name of a file in"),
    "training of a number": (lambda run: pirl_rl.train(42), "expected the name of an experiment"),
    "box of numbers": (lambda run: pirl_rl.Box(-1.0, 1.0), "Box: expected the lower and the upper corner as two lists"),
    "check of a class with arguments": (lambda run: pirl_rl.check(Windy), r"problem: Windy needs arguments \(.*'wind'"),
    "training of a class with arguments": (lambda run: pirl_rl.train(Windy), "env.problem.wind: a value is missing"),
    "physics of numpy": (lambda run: pirl_rl.check(Windy(np.sin)), "need functions of torch, such as torch.sin"),
    "levels of numpy": (lambda run: pirl_rl.check(Windy(torch.sin, np.abs)), "need functions of torch"),
    "planes as a method": (lambda run: pirl_rl.check(Planes(torch.sin)), r"Planes.planes \(.*: expected a result"),
    "exact value of numpy": (lambda run: pirl_rl.check(Exact(torch.sin)), r"Exact.exact_value \(.*: expected a result"),
    "one seed": (lambda run: pirl_rl.train("reach1d", seeds=3), r"seeds: expected a list of integers, .* got 3"),
    "training of nothing known": (lambda run: pirl_rl.train("nowhere"), "experiment: expected one of cartpole"),
    "training of an unknown setting": (lambda run: pirl_rl.train("reach1d", speed=3), "speed: expected one of"),
    "training into a finished run": (
        lambda run: pirl_rl.train("reach1d", folder=run.folder),
        "expected an empty direc",
    ),
    "training into a file": (lambda run: pirl_rl.train("reach1d", folder=run.folder / "summary.json"), "is a file"),
    "check of a number": (lambda run: pirl_rl.check(42), "problem: expected an object of a subclass"),
    "check with a negative step": (lambda run: pirl_rl.check(ZermeloBoat(), dt=-1), "dt: expected 0 < dt <= horizon"),
}

SMALL = ("+experiment=reach1d", "+debug=default", "env.dt=0.1", "env.substeps=1", "figures=false")


def of_own(name: str, *settings: str) -> tuple[str, ...]:
    return ("+experiment=own", "+debug=default", f"env.problem._target_=own.{name}", *settings)


COMMANDS = {
    "unknown experiment": (train, ("+experiment=nowhere",), "experiment: expected one of cartpole, "),
    "unknown logger": (train, (*SMALL, "logger=paper"), "logger: expected one of csv, none"),
    "experiment that is no YAML": (train, ("--config-dir=.", "+experiment=bad"), r"while parsing .*bad.yaml\", line 1"),
    "setting without a key": (train, (*SMALL, "=3"), "=3: expected key=value, got no key"),
    "setting with open brackets": (train, (*SMALL, "pirl.final=[1"), r"pirl.final=\[1: expected key=value"),
    "negative updates": (train, (*SMALL, "trainer.updates=-5"), "trainer.updates: expected an integer >= 1, got -5"),
    "updates of text": (train, (*SMALL, "trainer.updates=many"), "trainer.updates: expected int, got 'many'"),
    "negative rate": (train, (*SMALL, "learner.learning_rate=-1"), "learner: expected learning_rate > 0"),
    "target actor at rest": (train, (*SMALL, "learner.actor_polyak=0"), "actor_polyak: expected a number in"),
    "rate that diverges": (train, (*SMALL, "learner.learning_rate=1e6"), "td_loss is not finite or above"),
    "no time step": (train, (*SMALL, "env.dt=0"), "env.dt: expected 0 < dt <= horizon"),
    "time step of text": (train, (*SMALL, "env.dt=soon"), "env.dt: expected float, got 'soon'"),
    "negative width": (train, (*SMALL, "actor.hidden=[-4]"), r"actor.hidden: expected widths .* got \[-4\]"),
    "a width alone": (train, (*SMALL, "critic.hidden=64"), r"critic.hidden: expected list\[int\], got 64"),
    "no paths": (train, (*SMALL, "env.num_envs=0"), "env.num_envs: expected an integer >= 1, got 0"),
    "two weights": (train, (*SMALL, "pirl.final=[1,2]"), "expected three finite weights"),
    "unknown device": (train, (*SMALL, "device=toaster"), "device: expected auto, cpu or cuda"),
    "negative seed": (train, (*SMALL, "seed=-1"), "seed: expected an integer >= 0"),
    "foreign class": (train, (*SMALL, "env.problem._target_=os.system"), "os.system is not a class"),
    "start that is not there": (train, (*SMALL, "start=nowhere"), "no checkpoint at nowhere"),
    "start that is no checkpoint": (train, (*SMALL, "start=own.py"), "own.py is not a checkpoint"),
    "directory that is a file": (train, (*SMALL, "hydra.run.dir=own.py"), "expected a directory, but own.py is a file"),
    "directory of another run": (train, (*SMALL, "hydra.run.dir=run"), "expected an empty directory"),
    "unknown problem": (train, of_own("Nothing"), "cannot load own.Nothing"),
    "problem of a broken module": (train, ("+experiment=own", "env.problem._target_=broken.P"), "SyntaxError"),
    "problem that raises at once": (train, of_own("NoMap"), r"ValueError: no map.png \(.*own.py, line \d+\)"),
    "problem that lacks methods": (train, of_own("Abstract"), "Abstract lacks diffusion, drift"),
    "drift that is not a number": (train, of_own("NanDrift", "check=true"), r"NanDrift.drift \(own.py, line \d+\)"),
    "drift that raises": (train, of_own("Raises"), r"KeyError: 'speed' \(.*own.py, line \d+\)"),
    "drift of integers": (
        train,
        of_own("Integers", "check=true"),
        r"Integers.drift .* expected a tensor of torch.float",
    ),
    "endless horizon": (train, of_own("Endless"), "horizon must be positive and finite, got inf"),
    "target out of reach": (
        train,
        of_own("Beyond", "check=true"),
        r"Beyond.target_level \(own.py, line \d+\): no point",
    ),
    "evaluation of the car": (train, of_own("Own", "evaluation=drift"), "states of VehicleDrift alone"),
    "resumption of nothing": (train, ("resume=nowhere",), "nowhere is not a run directory"),
    "resumption with a new key": (train, ("resume=run", "+speed=3"), r"\+speed=3: expected key=value of an existing"),
    "resumption with other networks": (
        train,
        ("resume=run", "critic.hidden=[8]"),
        "critics have weights of the shapes",
    ),
    "resumption to an earlier end": (train, ("resume=run", "trainer.updates=3"), "expected at least 20"),
    "evaluation of nothing": (evaluate, ("run=nowhere",), "nowhere is not a run directory"),
    "evaluation without episodes": (
        evaluate,
        ("run=run", "evaluation.final=[success]", "evaluation.success.episodes=0"),
        "episodes >= 1, got 0",
    ),
    "export over a file": (export, ("run=run", "out=own.py"), "own.py exists, and an export never overwrites"),
    "check of nothing": (check, ("own:Nothing",), "own has no class 'Nothing'"),
    "check with a step of text": (check, ("own:Own", "dt=soon"), "dt: expected 0 < dt <= horizon = 1.0, got 'soon'"),
    "check with open brackets": (check, ("own:Own", "dt=["), r"dt=\[: expected key=value \(while parsing"),
    "certificate with open brackets": (certify, ("run=run", "x=[0"), r"x=\[0: expected key=value \(while parsing"),
    "suite with open brackets": (suite, ("seeds=[0",), r"seeds=\[0: expected key=value \(while parsing"),
    "suite of nothing known": (suite, ("problems=[chess]",), "problems: expected names out of"),
    "loop from nowhere": (tune, ("+experiment=reach1d", "start=nowhere"), "no checkpoint at nowhere"),
    "loop of many rounds": (tune, ("+experiment=reach1d", "start=run", "rounds=many"), "rounds: expected int"),
}


@pytest.fixture(scope="module")
def run(trained):
    run = pirl_rl.load_run(trained)
    run.folder = trained
    return run


def contents(folder: Path) -> dict[Path, bytes]:
    """The files of a folder except the lock of a run and what Python caches."""
    ignored = (RunDirectory.LOCK.name, "__pycache__")
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and not {*ignored} & {*path.parts}}


@pytest.mark.parametrize("name", CALLS)
def test_a_call_that_makes_no_sense_is_refused(name, run, tmp_path, monkeypatch):
    call, message = CALLS[name]
    monkeypatch.chdir(tmp_path)
    before = contents(run.folder)
    with pytest.raises(PirlError, match=message) as caught:
        call(run)
    assert "\n" not in str(caught.value)
    assert contents(run.folder) == before
    assert not contents(tmp_path)


@pytest.fixture
def workplace(trained, tmp_path, monkeypatch) -> Path:
    """A folder with a run, a module of a user's problems, and a user's experiment that is no YAML."""
    monkeypatch.syspath_prepend(str(tmp_path))
    shutil.copytree(trained, tmp_path / "run")
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "broken.py").write_text("def f(:\n")
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "bad.yaml").write_text("env: {dt: [")
    for module in ("own", "broken"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    return tmp_path


def refused(printed: str) -> str:
    """The line with the error, after a check that nothing else is said about it."""
    assert "Traceback" not in printed
    (line,) = [line for line in printed.splitlines() if line.startswith("error: ")]
    assert printed.splitlines()[-1] == line
    return line


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_makes_no_sense_is_refused(name, workplace, in_process):
    module, arguments, message = COMMANDS[name]
    before = contents(workplace)
    code, printed = in_process(module)(*arguments)
    assert code == 1
    assert re.search(message, refused(printed))
    left = contents(workplace)
    assert {path: left.get(path) for path in before} == before
    # A run that diverges keeps its metrics, which show what happened.
    assert name == "rate that diverges" or left.keys() == before.keys()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


def spoil(path: Path) -> None:
    """Make one weight infinite."""
    state = torch.load(path, weights_only=True)
    networks = state["learner"]["loss"]
    name = next(name for name in networks if name.startswith("qvalue_network_params") and name.endswith("weight"))
    networks[name].view(-1)[0] = math.inf
    torch.save(state, path)


def link(path: Path) -> None:
    outside = path.parents[2] / "outside"
    shutil.move(path.parent, outside)
    path.parent.symlink_to(outside)


def rename_class(path: Path) -> None:
    path.write_text(path.read_text().replace("pirl_rl.problems.Reach1D", "os.system"))


FILES = {
    "cut checkpoint": (RunDirectory.LAST, cut, "last.pt is"),
    "flipped bit": (RunDirectory.LAST, flip, "last.pt is damaged"),
    "infinite weight": (RunDirectory.LAST, spoil, "expected finite numbers"),
    "empty checkpoint": (RunDirectory.LAST, lambda path: path.write_bytes(b""), "last.pt is not a checkpoint"),
    "no checkpoint": (RunDirectory.LAST, lambda path: shutil.rmtree(path.parent), "no checkpoint at"),
    "cut configuration": (RunDirectory.CONFIG, lambda path: path.write_text("env: {dt: ["), "config.yaml"),
    "empty configuration": (RunDirectory.CONFIG, lambda path: path.write_text(""), "config.yaml"),
    "configuration with a foreign class": (RunDirectory.CONFIG, rename_class, "os.system"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_spoilt_file_is_refused(name, workplace, in_process):
    """By `load_run` and by `evaluate` with the same words, and nothing is written."""
    path, spoilt_by, message = FILES[name]
    spoilt_by(workplace / "run" / path)
    before = contents(workplace)
    with pytest.raises(PirlError, match=message):
        pirl_rl.load_run(workplace / "run")
    code, printed = in_process(evaluate)("run=run")
    assert code == 1
    assert re.search(message, refused(printed))
    assert contents(workplace) == before


def test_a_linked_folder_is_not_written_through(workplace, in_process):
    link(workplace / "run" / RunDirectory.LAST)
    before = contents(workplace / "outside")
    code, printed = in_process(train)("resume=run", "trainer.updates=30")
    assert code == 1
    assert "link" in refused(printed)
    assert contents(workplace / "outside") == before


@pytest.mark.parametrize("spoilt", [RunDirectory.SUMMARY, RunDirectory.CONFIG])
def test_a_spoilt_file_is_refused_by_those_who_compare(spoilt, workplace, in_process):
    (workplace / "run" / spoilt).write_text("{")
    code, printed = in_process(compare)("run")
    assert code != 0
    assert spoilt.name in printed
    assert "Traceback" not in printed


def test_states_far_outside_the_box_are_warned_of(run):
    with pytest.warns(UserWarning, match="far outside the box of states"):
        run.value(1, [[50.0]])


def test_the_tables_have_more_than_sixty_rows():
    assert len(CALLS) + len(COMMANDS) + len(FILES) >= 60
