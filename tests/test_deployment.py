"""Models: the same numbers as the solution that they are made of, without this package and without torch."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from small import small_config
from torch.fx.experimental.proxy_tensor import make_fx

from pirl_rl import Box, ReachAvoidProblem, load_run
from pirl_rl.checkpoint import digest
from pirl_rl.commands.export import export_model, main
from pirl_rl.configuration import save_config
from pirl_rl.deployment import Program, describe, write_model
from pirl_rl.deployment.graph import record
from pirl_rl.deployment.simplify import simplify
from pirl_rl.errors import ArgumentError, ConfigError
from pirl_rl.layers import Levels
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.payoffs import LipschitzPayoff
from pirl_rl.problems import DubinsCar, Pendulum, PlanarQuadrotor, Reach1D, ZermeloBoat
from pirl_rl.problems.drift.problem import VehicleDrift
from pirl_rl.sampling.faces import find_faces
from pirl_rl.solution import Solution

ROOT = Path(__file__).parents[1]
NAMES = {"value": "value", "gradient": "gradient", "control": "policy"}
"""The outputs of a model, with the methods of a solution that they equal."""

TOLERANCE = 1e-5
"""Of V, and of gradient and control as a share of the largest: some tens of roundings in single precision."""

WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None  # any import of it fails
import numpy as np
import onnxruntime

session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
states = np.load(sys.argv[2])
outputs = [output.name for output in session.get_outputs()]
answer = dict(zip(outputs, session.run(None, {"tau": states["tau"], "x": states["x"]}), strict=True))
metadata = session.get_modelmeta().custom_metadata_map
np.savez(sys.argv[3], **answer, **{"meta_" + name: np.array(entry) for name, entry in metadata.items()})
"""


def solution_of(problem: ReachAvoidProblem, critics: int = 1, actor: dict | None = None, **settings) -> Solution:
    """New networks for a problem, with a fixed seed."""
    torch.manual_seed(0)
    features = {"root_time": True, "levels": True, "activation": "SiLU", "spread": 3.0, "hidden": (16,)}
    critic = features | {"output": "Sigmoid", "log_levels": settings.get("levels", True)} | settings
    return Solution(
        problem,
        Actor(problem, **features, **(actor or {})),
        stack([Critic(problem, **critic) for _ in range(critics)]),
    )


def points(problem: ReachAvoidProblem, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Times to go and states, half of them on the faces of A and B and the rest in and around the box of states.

    States on a face whose level is not 0 but a rounding are left out: two programs may see them on either side.
    """
    rng = torch.Generator().manual_seed(1)
    faces = find_faces(problem, rng).points
    sets = (problem.reached_constraints, problem.avoid_constraints)
    sets = sets[1:] if problem.objective == "invariance" else sets
    levels = torch.cat([constraints(faces.double()) for constraints in sets], -1)
    faces = faces[((levels == 0) | (levels.abs() > 1e-6)).all(-1)]
    faces = faces[torch.randint(len(faces), (count // 2,), generator=rng)]
    x = torch.cat([faces, problem.states.expand(1.3).sample(count - len(faces), rng)])
    turning = torch.zeros(problem.states.dim)
    turning[[*problem.states.periodic]] = 1.0
    period = torch.tensor(problem.states.high) - torch.tensor(problem.states.low)
    x = x + turning * period * torch.randint(-1, 2, (count, 1), generator=rng)
    return problem.horizon * torch.rand(count, generator=rng), x


def assert_answers(answer, solution: Solution, tau: torch.Tensor, x: torch.Tensor, tolerance: float) -> None:
    for output, method in NAMES.items():
        expected = getattr(solution, method)(tau, x)
        scale = 1.0 if output == "value" else float(expected.abs().max())
        got = torch.as_tensor(answer[output])
        torch.testing.assert_close(
            got, expected, rtol=0, atol=tolerance * scale, msg=lambda text, o=output: f"{o}: {text}"
        )


@pytest.fixture(scope="module")
def dubins(tmp_path_factory) -> tuple[Solution, Path]:
    """Two critics of a problem with a periodic coordinate and sets with corners, and its ONNX model."""
    solution = solution_of(DubinsCar(), critics=2)
    return solution, write_model(solution, "onnx", tmp_path_factory.mktemp("onnx") / "model")


@pytest.mark.parametrize(
    "solution",
    [
        solution_of(DubinsCar()),
        solution_of(DubinsCar(payoff=LipschitzPayoff(0.1)), critics=2, action_input=True),
        solution_of(PlanarQuadrotor(), root_time=False, levels=False, activation="ReLU", output=None),
        solution_of(Pendulum(), activation="Tanh"),
        solution_of(VehicleDrift()),
        solution_of(Reach1D(), hidden=()),
        solution_of(PlanarQuadrotor(), actor={"choices": 5}),
        solution_of(PlanarQuadrotor(), actor={"choices": 3, "together": 2}),
        solution_of(PlanarQuadrotor(), actor={"choices": 33, "window": 0.5}),
        solution_of(ZermeloBoat(), actor={"log_levels": True}),
    ],
    ids=[
        "periodic",
        "smoothed",
        "plain",
        "invariance",
        "unreachable",
        "no avoid set",
        "choices",
        "together",
        "window",
        "logarithms",
    ],
)
def test_the_program_computes_what_the_solution_does(solution):
    """In double precision nothing but rounding differs, of the order of 1e-16 times the slope of the networks."""
    solution = Solution(solution.problem, solution.actor.double(), solution.critic.double())
    tau, x = (entry.double() for entry in points(solution.problem, 2_000))
    assert_answers(Program(solution)(tau, x), solution, tau, x, tolerance=1e-12)


class Branching(ReachAvoidProblem):
    """A level function that asks for the entries of a tensor."""

    horizon = 1.0
    states, controls = Box([-1.0], [1.0]), Box([-1.0], [1.0])

    def drift(self, x, u):
        return u

    def diffusion(self, x, u):
        return torch.ones_like(x).unsqueeze(-1)

    def target_level(self, x):
        return 0.5 - x[..., 0] if bool((x > 0).any()) else 0.5 - x[..., 0].abs()


class InPlace(Branching):
    """A level function that changes a tensor of its own."""

    def target_level(self, x):
        level = 0.5 - x[..., 0].abs()
        level *= 2
        return level


class Kept(PlanarQuadrotor):
    """Conditions on several entries at once, which keep their axis, and depend on the axis that they keep."""

    def unreachable(self, x):
        few = (x <= 0.4).all(-1, keepdim=True) & (x < 0.2).any(-1, keepdim=True)
        return (few & (x[..., :2] > -0.5)).all(-1)


def test_conditions_that_keep_their_axis_do_in_a_model(tmp_path):
    solution = solution_of(Kept())
    tau, x = points(solution.problem, 2_000)
    x[:1_000] = 0.5 * torch.rand(1_000, x.shape[1], generator=torch.Generator().manual_seed(2))
    assert 100 < Kept().unreachable(x).sum() < 1_900
    assert_answers(record(solution).module()(tau, x), solution, tau, x, TOLERANCE)
    session = pytest.importorskip("onnxruntime").InferenceSession(write_model(solution, "onnx", tmp_path))
    names = [output.name for output in session.get_outputs()]
    answer = dict(zip(names, session.run(None, {"tau": tau.numpy(), "x": x.numpy()}), strict=True))
    assert_answers(answer, solution, tau, x, TOLERANCE)


@pytest.mark.parametrize("problem", [VehicleDrift(), InPlace()], ids=["equal parts", "in place"])
def test_a_graph_has_the_numbers_of_the_solution_and_each_part_once(problem):
    """Networks and masks look the same levels up, and nothing is multiplied by ones."""
    solution = solution_of(problem)
    graph = record(solution)
    tau, x = points(problem, 500)
    assert_answers(graph.module()(tau, x), solution, tau, x, TOLERANCE)
    lines = [f"{node.target} {node.args}" for node in graph.graph.nodes if node.op == "call_function"]
    assert len(set(lines)) == len(lines)
    assert not any("ones_like" in line or "_unsafe" in line for line in lines)
    tables = sum("aten.index" in line for line in lines)
    assert tables == (2 if isinstance(problem, VehicleDrift) else 0)  # the two knots of the equilibria


def test_an_operator_with_side_effects_is_not_simplified():
    def doubled(x: torch.Tensor) -> torch.Tensor:
        return x.clone().mul_(2)

    graph = make_fx(doubled)(torch.ones(3)).graph
    with pytest.raises(ValueError, match="expected operators without side effects, got"):
        simplify(graph)


def test_copies_of_a_network_share_the_problem():
    actor = solution_of(DubinsCar()).actor
    one, other = (next(layer for layer in net.layers if isinstance(layer, Levels)) for net in (actor, deepcopy(actor)))
    assert one is not other
    assert one.levels is other.levels


def test_onnxruntime_evaluates_a_model_without_torch(dubins, tmp_path):
    solution, model = dubins
    tau, x = points(solution.problem, 10_000)
    np.savez(tmp_path / "states.npz", tau=tau.numpy(), x=x.numpy())
    files = [str(path) for path in (model, tmp_path / "states.npz", tmp_path / "answer.npz")]
    done = subprocess.run([sys.executable, "-c", WITHOUT_TORCH, *files], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    answer = np.load(tmp_path / "answer.npz")
    assert_answers(answer, solution, tau, x, TOLERANCE)
    assert {0.0, 1.0} <= {*answer["value"].tolist()}
    metadata = {name.removeprefix("meta_"): json.loads(str(answer[name])) for name in answer.files if "meta_" in name}
    assert metadata == json.loads((model.parent / "model.json").read_text()) == describe(solution)
    assert metadata["networks"] == digest(solution.arrays())


def test_a_model_names_no_file_of_this_machine(dubins):
    assert str(ROOT).encode() not in dubins[1].read_bytes()
    assert sorted(path.name for path in dubins[1].parent.iterdir()) == ["model.json", "model.onnx"]


def test_a_problem_that_no_graph_can_hold_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match="Branching: expected sets made of tensor operations alone"):
        write_model(solution_of(Branching(), levels=False), "torch", tmp_path)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(ArgumentError, match=r"onnxscript.*pip install 'pirl_rl\[export\]'"):
        write_model(solution_of(Pendulum()), "onnx", tmp_path)


def test_the_command_exports_a_run_as_a_program_of_torch(trained, tmp_path, capsys):
    folder, files = tmp_path / "model", {"model.json": ""}
    main([f"run={trained}", f"out={folder}", "format=torch"])
    assert f"written  {folder / 'model.pt2'}" in capsys.readouterr().out
    program, run = torch.export.load(folder / "model.pt2", extra_files=files).module(), load_run(trained)
    assert json.loads(files["model.json"]) == json.loads((folder / "model.json").read_text()) == describe(run.solution)
    for count in (2, 1_000):
        tau, x = points(run.problem, count)
        assert_answers(program(tau, x), run.solution, tau, x, TOLERANCE)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["format=tflite"], "format: expected one of run, onnx, torch, got tflite"),
        (["format=onnx", "more=1"], "expected run=RUN_DIR out=FOLDER"),
    ],
)
def test_the_command_refuses_in_one_line(arguments, message, trained, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([f"run={trained}", f"out={tmp_path / 'model'}", *arguments])
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error
    assert not list(tmp_path.iterdir())


def test_the_run_of_a_grid_is_refused(tmp_path):
    save_config(small_config("method=grid"), tmp_path / "grid")
    with pytest.raises(ConfigError, match="format: expected format=run for a run with method=grid"):
        export_model(tmp_path / "grid", tmp_path / "model", "onnx")


def test_nothing_is_overwritten_and_a_failure_leaves_nothing(trained, tmp_path, monkeypatch):
    (tmp_path / "model").mkdir()
    with pytest.raises(ConfigError, match="model exists"):
        export_model(trained, tmp_path / "model", "torch")
    monkeypatch.setattr("pirl_rl.deployment.model.record", lambda solution: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        export_model(trained, tmp_path / "other", "torch")
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
@pytest.mark.parametrize(
    "problem",
    [Pendulum(), *(pytest.param(p, marks=pytest.mark.slow) for p in (DubinsCar(), PlanarQuadrotor(), VehicleDrift()))],
)
def test_the_cpp_example_evaluates_a_model(problem, tmp_path):
    """States in general position: an operator may round the level of a state on a face to the other side."""
    solution = solution_of(problem, critics=2)
    model = write_model(solution, "onnx", tmp_path / "model")
    source, example = ROOT / "examples" / "cpp" / "evaluate.cpp", tmp_path / "evaluate"
    subprocess.run(["g++", "-std=c++17", "-O2", str(source), "-o", str(example)], check=True)
    rng = torch.Generator().manual_seed(1)
    x, tau = problem.states.expand(1.3).sample(1_000, rng), problem.horizon * torch.rand(1_000, generator=rng)
    rows = torch.cat([tau.unsqueeze(-1), x], -1).tolist()
    text = "\n".join(" ".join(map(repr, row)) for row in rows)
    done = subprocess.run([str(example), str(model)], input=text, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    table = torch.tensor([[float(word) for word in line.split()] for line in done.stdout.splitlines()])
    n = problem.states.dim
    answer = {"value": table[:, 0], "gradient": table[:, 1 : 1 + n], "control": table[:, 1 + n :]}
    assert_answers(answer, solution, tau, x, TOLERANCE)
