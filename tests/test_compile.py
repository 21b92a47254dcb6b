"""What is compiled, where a stage changes the actor rule and where no compiler is found."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from small import EVENTS, PHYSICS, QUICK, at_each_update, command, small_trainer
from torch._dynamo.utils import counters

from pirl_rl import learner
from pirl_rl.actor_rules import BestControl, ClippedSurrogate, LookAhead
from pirl_rl.assembly import make_trainer
from pirl_rl.commands.composition import compose
from pirl_rl.compilation import Compiled, compiled, rowwise
from pirl_rl.evaluation import statements_of
from pirl_rl.run_directory import RunDirectory
from pirl_rl.simulator import Simulator

RULES = (
    "stages=[{share: 1, actor_rule: {_target_: pirl_rl.actor_rules.LookAhead, steps: 2}}, "
    "{share: 1, exploration_noise: 0.2, actor_rule: {_target_: pirl_rl.actor_rules.ClippedSurrogate, deviation: 0.2}}]",
    "trainer.updates=8",
    "learner.actor_every=1",
)
"""A look ahead, of which the simulator's step alone is compiled, then a surrogate, which is compiled as a whole."""


needs_compiler = pytest.mark.skipif(
    not (shutil.which("g++") or shutil.which("clang++")), reason="torch.compile needs a C++ compiler"
)


def eager_calls(monkeypatch) -> list[str]:
    """Names of what should run compiled, one for each time that Python itself runs it."""
    calls: list[str] = []
    for owner, name in (
        (learner.PIRLLoss, "critic_loss"),
        (BestControl, "__call__"),
        (ClippedSurrogate, "__call__"),
        (Simulator, "flow"),
    ):
        inner = getattr(owner, name)

        def watched(self, *arguments, inner=inner, label=f"{owner.__name__}.{name}"):
            if not torch.compiler.is_compiling():
                calls.append(label)
            return inner(self, *arguments)

        monkeypatch.setattr(owner, name, watched)
    return calls


def train_over_rules(tmp_path, *overrides: str):
    trainer = small_trainer(tmp_path, *RULES, *overrides)
    rules = []
    at_each_update(trainer, lambda k: rules.append(type(trainer.learner.loss.actor_rule)))
    trainer.train()
    assert rules == [LookAhead] * 4 + [ClippedSurrogate] * 4
    return trainer


def assert_nothing_ran_eagerly(tmp_path, calls: list[str]) -> None:
    torch._dynamo.reset()
    counters.clear()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="updates run eagerly")
        trainer = train_over_rules(tmp_path, "compile=true")
    assert trainer.learner.gradients.compile
    assert calls == []
    assert not counters["graph_break"]


def test_a_new_rule_is_compiled_too(tmp_path, monkeypatch):
    """Traced whole by the compiler's front end; what it makes of it is left out here to save a minute."""
    calls = eager_calls(monkeypatch)
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager", fullgraph=True))
    assert_nothing_ran_eagerly(tmp_path, calls)


@pytest.mark.slow
@needs_compiler
def test_a_new_rule_is_compiled_to_machine_code(tmp_path, monkeypatch):
    assert_nothing_ran_eagerly(tmp_path, eager_calls(monkeypatch))


def test_a_new_rule_runs_eagerly_where_nothing_is_compiled(tmp_path, monkeypatch):
    calls = eager_calls(monkeypatch)
    train_over_rules(tmp_path, "compile=false")
    assert {*calls} == {"PIRLLoss.critic_loss", "ClippedSurrogate.__call__", "Simulator.flow"}


@pytest.mark.slow
def test_a_new_rule_without_a_compiler_on_the_path(tmp_path):
    """One warning, then both rules run eagerly to the end."""
    quick = ("+experiment=reach1d", "+debug=default", "evaluation.during=[]", "evaluation.final=[]")
    cache = tmp_path / "cache"
    done = command(
        *quick, *RULES, "compile=true", cwd=tmp_path, PATH="/nowhere", CXX="", TORCHINDUCTOR_CACHE_DIR=str(cache)
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("updates run eagerly") == 1
    assert "run      " in done.stdout


@pytest.mark.parametrize("experiment", ["reach1d", pytest.param("dubins", marks=pytest.mark.slow)])
def test_the_default_losses_are_one_program_each(experiment, tmp_path, monkeypatch):
    """Traced whole by the compiler's front end; a loss that breaks into pieces costs several times as much."""
    calls = eager_calls(monkeypatch)
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager", fullgraph=True))
    torch._dynamo.reset()
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="updates run eagerly")
        warnings.filterwarnings("error", message=".* runs eagerly")
        trainer = small_trainer(tmp_path, "compile=true", base=(f"+experiment={experiment}", *QUICK[1:], *EVENTS))
        trainer.train()
    assert isinstance(trainer.learner.loss.actor_rule, BestControl)
    assert calls == []


@needs_compiler
def test_a_table_may_be_interpolated_in_physics_that_are_differentiated_twice():
    """`torch.lerp` of a table gives its derivatives zeros without memory, at which a compiled program once crashed."""
    table = torch.arange(9.0).view(3, 3)

    def interpolated(x):
        knot = x[:, 0].detach().long()
        return torch.lerp(table[knot], table[knot + 1], x.square())

    def curvature(x):
        def slope(y):
            return torch.func.jvp(interpolated, (y,), (torch.ones_like(y),))[1]

        return torch.func.jvp(slope, (x,), (torch.ones_like(x),))[1]

    x = 2 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(compiled(curvature, whole=True)(x), torch.full_like(x, 6.0))


@pytest.mark.slow
@needs_compiler
@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("settings", [(), PHYSICS, ("method=td3",), (*PHYSICS, "loss.hjb_probes=2")], ids=str)
def test_compiled_and_eager_trainings_have_the_same_curves(settings, tmp_path):
    """All metrics of 20 updates, also with noise in the loss, which is drawn outside of the compiled program."""
    tables = []
    for compile in ("true", "false"):
        trainer = small_trainer(tmp_path / compile, *settings, f"compile={compile}")
        trainer.train()
        assert trainer.learner.gradients.compile == (compile == "true")
        tables.append(np.genfromtxt(RunDirectory(tmp_path / compile).metrics, delimiter=",", skip_header=1))
    assert len(tables[0]) > 5
    np.testing.assert_allclose(*tables, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "shared"),
    [
        ((), True),
        (("env.num_envs=64", "collector.frames_per_batch=640"), False),
        (("evaluation.simulator.substeps=3",), False),
        (("compile=false",), False),
    ],
)
def test_evaluators_share_the_compiled_simulator_of_the_environment(settings, shared):
    """Where it has the same steps and as many paths as they play at once."""
    trainer = make_trainer(compose("train", ["+experiment=reach1d", "device=cpu", "logger=none", *settings]))
    simulator = trainer.simulator
    assert (simulator.shared is not None) == shared
    # Evaluators that take single steps, of other numbers of paths, do not compile them.
    assert simulator.compile is (None if "compile=false" not in settings else False)
    assert replace(simulator, dt=0.5).shared is None


@pytest.mark.slow
@needs_compiler
def test_all_evaluators_play_a_shared_simulator():
    """They play other numbers of paths than the environment; each would otherwise be compiled by itself."""
    numbers = ("success.episodes", "calibration.rollouts", "slices.rollouts", "verdict.rollouts")
    paths = [f"evaluation.{number}=2" for number in numbers]
    trainer = make_trainer(compose("train", ["+experiment=reach1d", "device=cpu", "logger=none", *paths]))
    assert {"success_rate", "calibration_mse", "verdict"} <= {*trainer.finish(), *statements_of(trainer.evidence)}


@needs_compiler
def test_a_function_of_rows_is_compiled_where_it_is_mapped():
    eager: list[tuple[int, ...]] = []

    def function(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        if not torch.compiler.is_compiling():
            eager.append(tuple(x.shape))
        return x.sin() * y.unsqueeze(-1)

    x, y = torch.randn(3, 5, 2), torch.randn(3, 5)
    mapped = rowwise(function, "the function")
    with torch.no_grad():
        all_own = torch.func.vmap(mapped)(x, y)
        last_axis = torch.func.vmap(mapped, in_dims=(2, None))(x.movedim(0, 2), y[0])
    assert eager == []
    torch.testing.assert_close(all_own, function(x, y))
    torch.testing.assert_close(last_axis, function(x, y[0]))
    eager.clear()
    x.requires_grad_()
    mapped(x[0], y[0]).sum().backward()  # gradients need the function itself
    assert eager == [(5, 2)]
    torch.testing.assert_close(x.grad[0], x[0].detach().cos() * y[0].unsqueeze(-1))


def fitted(network: torch.nn.Linear):
    """The error of each member at its rows beside a network, with the gradient in the weights of the members."""

    def program(own: dict[str, torch.Tensor], scale: float, weights: list[torch.Tensor], offset: torch.Tensor | None):
        def of_member(x, weight):
            shift = 0.0 if offset is None else offset
            return ((network(x) - x @ weight + shift) * scale).square().mean()

        errors = torch.func.vmap(of_member)(own["x"], weights[0])
        return errors.detach(), {"grad": torch.autograd.grad(errors.sum(), weights)}, None

    return program


@needs_compiler
def test_a_traced_function_is_the_function(recwarn):
    torch.manual_seed(0)
    network = torch.nn.Linear(3, 2)
    function = fitted(network)
    traced = Compiled(function, "the errors", traced=True)
    for members, rows, scale, offset in ((4, 5, 1.0, None), (2, 5, 1.0, None), (2, 5, 3.0, torch.ones(2))):
        for _ in range(2):
            x, weight = torch.randn(members, rows, 3), torch.randn(members, 3, 2, requires_grad=True)
            arguments = {"x": x}, scale, [weight], offset
            torch.testing.assert_close(traced(*arguments), function(*arguments))
            with torch.no_grad():  # what it holds may change in place
                network.weight.mul_(-1.5)
    assert len(traced._called._programs) == 3
    assert not [one for one in recwarn if "runs eagerly" in str(one.message)]


def test_what_cannot_be_traced_runs_eagerly_or_has_its_own_error():
    def branches(x):
        return x * 2 if x.sum().item() > 0 else x

    traced = Compiled(branches, "the branches", traced=True)
    with pytest.warns(UserWarning, match="the branches runs eagerly"):
        assert traced(torch.ones(3)).tolist() == [2.0] * 3
    assert traced(-torch.ones(3)).tolist() == [-1.0] * 3
    mapped = Compiled(torch.func.vmap(branches), "the branches", traced=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RuntimeError, match="vmap"):
            mapped(torch.ones(2, 3))
