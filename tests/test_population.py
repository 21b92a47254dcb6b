"""A population: its members are the runs that they would be alone, and end, stop and resume like them."""

from __future__ import annotations

import json
import math
import sys

import pytest
import torch
from small import PHYSICS, QUICK, at_update, command, interrupt, small_config, small_trainer

import pirl_rl
from pirl_rl import checkpoint, train
from pirl_rl.assembly import make_trainer
from pirl_rl.commands.train import go_on, resume
from pirl_rl.configuration import save_config
from pirl_rl.continuation import restore
from pirl_rl.errors import ArgumentError, Interrupted
from pirl_rl.population import Population
from pirl_rl.problems import Reach1D
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.sweeps import find_jobs
from pirl_rl.trainer import Trainer

TD3 = ("method=td3",)
PAPER = ("method=pirl_paper", "schedule.center=0.3", "schedule.steepness=30")
PROBES = (*PHYSICS, "loss.hjb_probes=2")


def population(trainers: list[Trainer]) -> Population:
    """The trainers with the random numbers that they would have alone."""
    numbers = []
    for seed in range(len(trainers)):
        torch.manual_seed(seed)
        numbers.append(checkpoint.global_rng_states())
    return Population(trainers, numbers)


def alone(trainers: list[Trainer]) -> None:
    for index, trainer in enumerate(trainers):
        torch.manual_seed(index)
        trainer.train()


def assert_equal(ones: list[Trainer], others: list[Trainer], tolerance: float) -> None:
    for one, other in zip(ones, others, strict=True):
        pairs = zip(one.learner.loss.parameters(), other.learner.loss.parameters(), strict=True)
        assert max(float((a - b).detach().abs().max()) for a, b in pairs) < tolerance
        assert one.update == other.update


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param((), id="default"),
        *(
            pytest.param(other, id=name, marks=pytest.mark.slow)
            for name, other in (("physics", PHYSICS), ("td3", TD3), ("paper", PAPER), ("probes", PROBES))
        ),
    ],
)
def test_members_equal_runs_of_their_own(settings, tmp_path):
    """Networks, targets and logged losses after 20 updates, up to rounding in double precision."""

    def trainers(name: str) -> list[Trainer]:
        return [small_trainer(tmp_path / name / str(seed), f"seed={seed}", *settings) for seed in (0, 1, 2)]

    singles, members = trainers("alone"), trainers("together")
    alone(singles)
    population(members).train()
    assert_equal(singles, members, 1e-9)
    for single, member in zip(singles, members, strict=True):
        rows = [RunDirectory(one.folder).metrics.read_text().splitlines() for one in (single, member)]
        assert rows[0][0] == rows[1][0]
        assert len(rows[0]) == len(rows[1])
        for one, other in zip(*(map(float, lines[-1].split(",")) for lines in rows), strict=True):
            assert one == pytest.approx(other, rel=1e-6, nan_ok=True)


@pytest.mark.slow
@pytest.mark.usefixtures("float64")
@pytest.mark.filterwarnings("error:.* runs eagerly")
def test_compiled_losses_give_the_same_members(tmp_path):
    compiled, eager = (
        [small_trainer(tmp_path / f"{compile}{seed}", f"seed={seed}", f"compile={compile}") for seed in (0, 1)]
        for compile in ("true", "false")
    )
    population(compiled).train()
    population(eager).train()
    assert_equal(compiled, eager, 1e-9)


@pytest.mark.usefixtures("float64")
def test_members_differ_in_schedules_and_rates(tmp_path):
    """Where the schedule of one member has no physics yet, that of another may have it."""
    centers, rates = (0.1, 0.9), (1e-3, 3e-3)

    def trainers(name: str) -> list[Trainer]:
        base = (*PHYSICS, "schedule.steepness=300", "trainer.log_every=1")
        return [
            small_trainer(tmp_path / name / str(i), *base, f"schedule.center={center}", f"learner.learning_rate={rate}")
            for i, (center, rate) in enumerate(zip(centers, rates, strict=True))
        ]

    singles, members = trainers("alone"), trainers("together")
    alone(singles)
    population(members).train()
    assert_equal(singles, members, 1e-9)
    early, late = (RunDirectory(one.folder).metrics.read_text() for one in members)
    assert early.count("nan") < late.count("nan")


@pytest.mark.parametrize("spoilt", [[0], [0, 1]])
def test_members_that_diverge_end_alone(spoilt, tmp_path):
    members = [small_trainer(tmp_path / str(seed), f"seed={seed}") for seed in (0, 1)]
    one = population(members)

    def spoil():
        for index in spoilt:
            with torch.no_grad():
                next(iter(members[index].learner.loss.qvalue_network_params.parameters())).fill_(math.nan)

    at_update(members[0], 5, spoil)
    summaries = one.train()
    assert [index for index, summary in enumerate(summaries) if summary is None] == spoilt == [*one.errors]
    assert all("update 5" in str(error) for error in one.errors.values())
    for index in {0, 1} - {*spoilt}:
        assert members[index].update == members[index].updates
        assert all(parameter.isfinite().all() for parameter in members[index].learner.loss.parameters())


@pytest.mark.usefixtures("float64")
def test_an_interrupted_population_goes_on_as_if_nothing_had_happened(tmp_path):
    whole, begun = (
        [small_trainer(tmp_path / name / str(s), f"seed={s}") for s in (0, 1)] for name in ("whole", "begun")
    )
    population(whole).train()
    at_update(begun[0], 7, interrupt)
    with pytest.raises(Interrupted):
        population(begun).train()
    again, numbers = [], []
    for seed in (0, 1):
        trainer = small_trainer(tmp_path / "begun" / str(seed), f"seed={seed}")
        restore(trainer)
        again.append(trainer)
        numbers.append(checkpoint.global_rng_states())
    Population(again, numbers).train()
    assert_equal(whole, again, 1e-9)


def test_ctrl_c_while_members_begin_ends_with_ctrl_c(tmp_path):
    """The log of the second member was not opened, so that it is not closed."""
    pytest.importorskip("tensorboard")
    members = [small_trainer(tmp_path / str(s), f"seed={s}", "logger=tensorboard") for s in (0, 1)]

    def stop():
        raise KeyboardInterrupt

    members[0].begin = stop
    with pytest.raises(KeyboardInterrupt):
        population(members).train()


class Branches(Reach1D):
    """A drift with a decision on the values of the states, which cannot be made for all members at once."""

    def drift(self, x, u):
        if x.isnan().any():
            raise ValueError("x is not a number")
        return u


def test_a_problem_that_cannot_be_mapped_is_refused_by_name(tmp_path):
    config = small_config(*PHYSICS)
    members = [make_trainer(config.copy(), tmp_path / str(seed), problem=Branches()) for seed in (0, 1)]
    with pytest.raises(
        ArgumentError, match=r"trainer\.seeds, .*: a function of the problem cannot be evaluated .* -m seed=0,1"
    ):
        population(members).train()


def test_a_refused_population_leaves_no_directory(tmp_path):
    settings = {"updates": 3, "debug": "default", "schedule.initial": [1, 1, 1], "evaluation.final": []}
    with pytest.raises(ArgumentError, match=r"trainer\.seeds"):
        pirl_rl.train(Branches, folder=tmp_path / "out", seeds=[0, 1], **settings)
    assert not (tmp_path / "out").exists()


def test_members_have_networks_of_one_shape(tmp_path):
    members = [small_trainer(tmp_path / str(wide), f"actor.hidden=[{wide}]") for wide in (4, 5)]
    with pytest.raises(ArgumentError, match="networks of the same shapes"):
        population(members)


def test_the_command_trains_and_resumes_a_population(tmp_path, in_process):
    settings = ("trainer.seeds=[3,4]", "schedule.center=[0.2,0.4]", "report=false", "hydra.run.dir=out")
    code, text = in_process(train)(*QUICK, *settings)
    assert code == 0, text
    folders = [tmp_path / "out" / name for name in ("0-pirl-3", "1-pirl-4")]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        ".hydra",
        *(one.name for one in folders),
        "summary.json",
    ]
    values = [RunDirectory(folder).numbers()["value_mse"] for folder in folders]
    means = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert means["members"] == 2
    assert means["value_mse"] == pytest.approx(sum(values) / 2)
    assert [job.settings["schedule.center"] for job in find_jobs(tmp_path / "out")] == ["0.2", "0.4"]
    run = pirl_rl.load_run(folders[1])
    assert run.config.seed == 4
    assert run.config.trainer.seeds is None
    (tmp_path / "out" / "summary.json").unlink()
    resume(tmp_path / "out", [])
    assert (tmp_path / "out" / "summary.json").exists()


DIES = """
import os
from pathlib import Path
from pirl_rl.loggers import CSVLogger

class Dies(CSVLogger):
    made = 0
    def __init__(self):
        Dies.made += 1
        if Dies.made == 2 and not Path("died").exists():
            Path("died").touch()
            os._exit(9)
"""


def test_a_population_that_was_killed_while_it_began_is_resumed(tmp_path, in_process, monkeypatch):
    """The process dies while the second member begins; resumed, both end as in a population that was not killed."""
    (tmp_path / "dies.py").write_text(DIES)
    monkeypatch.syspath_prepend(tmp_path)
    settings = (*QUICK, "trainer.seeds=[3,4]", "schedule.center=[0.2,0.4]", "report=false", "trainer.updates=6")
    settings += ("logger._target_=dies.Dies",)
    assert command(*settings, "hydra.run.dir=killed", cwd=tmp_path).returncode == 9
    code, text = in_process(train)("resume=killed", "trust=[dies]")
    assert code == 0, text
    code, text = in_process(train)(*settings, "hydra.run.dir=whole")
    assert code == 0, text
    for name in ("0-pirl-3", "1-pirl-4"):
        killed, whole = (RunDirectory(tmp_path / folder / name) for folder in ("killed", "whole"))
        assert killed.metrics.read_text() == whole.metrics.read_text()
        assert killed.overrides.read_text() == whole.overrides.read_text()
    sys.modules.pop("dies", None)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["trainer.seeds=[]"], "trainer.seeds: expected a list of different seeds"),
        (["trainer.seeds=[1,1]"], "trainer.seeds: expected a list of different seeds"),
        (["trainer.seeds=3"], "trainer.seeds: expected a list of different seeds"),
        (["trainer.seeds=[0,x]"], "trainer.seeds: expected int, got 'x'"),
        (["trainer.seeds=[0,1]", "schedule.center=[0.1]"], "schedule.center: expected 2 values"),
        (["trainer.seeds=[0,1]", "method=grid"], "trainer.seeds: expected null with method=grid"),
    ],
)
def test_bad_populations_leave_nothing(settings, message, tmp_path, in_process):
    code, text = in_process(train)(*QUICK, *settings)
    assert code == 1
    assert message in text
    assert not list(tmp_path.iterdir())


def test_python_trains_a_population(tmp_path):
    settings = {"debug": "default", "report": False, "figures": False, "evaluation.final": ["exact"]}
    runs = pirl_rl.train("reach1d", seeds=[0, 1], folder=tmp_path / "out", **settings)
    assert [run.config.seed for run in runs] == [0, 1]
    assert runs[0].update > 0


@pytest.mark.parametrize("trust", ["trust=[my_module]", "trust=my_module", "trust=['my_module']"])
def test_modules_that_a_resuming_command_names_are_trusted(trust, tmp_path, monkeypatch):
    """A population of one's own problem is resumed by the line that it printed, with trust=[my_module]."""
    seen = []
    save_config(small_config("trainer.seeds=[0,1]"), tmp_path)
    monkeypatch.setattr("pirl_rl.commands.train.resume_population", lambda *arguments: seen.append(arguments[3]))
    go_on(tmp_path, [trust], ["another"])
    assert seen == [["my_module", "another"]]
