"""Conversion of configurations of format 1."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from pirl_rl.building import resolve
from pirl_rl.configuration import load_config, save_config
from pirl_rl.errors import ConfigError
from pirl_rl.renames import MOVED, upgraded
from pirl_rl.run_directory import FORMAT, RunDirectory

DATA = Path(__file__).parent / "data"
DRIFT, REACH1D = DATA / "format1_drift" / ".hydra" / "config.yaml", DATA / "reach1d_format1.yaml"
RULES = "pirl_rl.actor_rules"
Q, HAMILTONIAN = {"_target_": f"{RULES}.Q"}, {"_target_": f"{RULES}.Hamiltonian"}


def resolved(path: Path) -> dict:
    return OmegaConf.to_container(OmegaConf.load(path), resolve=True)


def targets(value) -> set[str]:
    """All `_target_`s in nested dicts and lists."""
    if isinstance(value, dict):
        own = {value["_target_"]} if "_target_" in value else set()
        return own.union(*map(targets, value.values()))
    return set().union(*map(targets, value)) if isinstance(value, list) else set()


def keys(value) -> set[str]:
    if isinstance(value, dict):
        return {*value}.union(*map(keys, value.values()))
    return set().union(*map(keys, value)) if isinstance(value, list) else set()


@pytest.mark.parametrize("path", [DRIFT, REACH1D], ids=["drift", "reach1d"])
def test_every_target_is_found(path):
    before = resolved(path)
    kept = copy.deepcopy(before)
    new = upgraded(before)
    assert before == kept
    for target in targets(new):
        if not target.startswith(RULES):
            resolve(target, "target")
    assert not targets(new) & MOVED.keys()
    assert not keys(new) & {"pirl", "model_steps", "ppo_clip"}
    assert not keys(new["loss"]) & {"simulator", "exploration_noise"}
    for name, node in new["evaluation"].items():
        assert name == "simulator" or not keys(node) & {"dt", "substeps", "crossing"}


@pytest.mark.parametrize("target", MOVED.values())
def test_what_moved_is_there(target):
    assert resolve(target, "target").__name__ == target.rpartition(".")[2]


def test_the_model_of_the_drifting_car():
    new = upgraded(resolved(DRIFT))
    assert new["loss"]["actor_rule"] == {"_target_": f"{RULES}.LookAhead", "steps": 3}
    first, second, third = new["stages"]
    assert [stage["share"] for stage in new["stages"]] == [8, 4, 5]
    assert first["actor_rule"] == {"_target_": f"{RULES}.ClippedSurrogate", "clip": 0.2, "deviation": 0.2}
    assert second["actor_rule"] == {"_target_": f"{RULES}.ClippedSurrogate", "clip": 0.2, "deviation": 0.1}
    assert third == {"share": 5, "train_actor": False, "n_steps": 50, "learning_rate": 0.001}
    assert first["initial_states"]["_target_"] == "pirl_rl.problems.drift.starts.EquilibriumStates"
    steps = {name: f"${{env.{name}}}" for name in ("dt", "substeps", "crossing")}
    assert new["evaluation"]["simulator"] == {"_target_": "pirl_rl.simulator.Simulator", **steps}
    assert new["schedule"]["initial"] == [1, 0.1, 1]


@pytest.mark.parametrize(
    ("loss", "noise", "rule"),
    [
        ({"actor_rule": "q"}, 0.2, Q),
        ({"actor_rule": "hamiltonian"}, 0.0, HAMILTONIAN),
        ({"actor_rule": "both"}, 0.2, {"_target_": f"{RULES}.Sum", "rules": [Q, HAMILTONIAN]}),
        ({}, 0.2, {"_target_": f"{RULES}.Sum", "rules": [Q, HAMILTONIAN]}),
        ({"actor_rule": "model", "model_steps": 8}, 0.0, {"_target_": f"{RULES}.LookAhead", "steps": 8}),
        ({"actor_rule": "ppo"}, 0.3, {"_target_": f"{RULES}.ClippedSurrogate", "clip": 0.2, "deviation": 0.3}),
        (
            {"actor_rule": "ppo", "ppo_clip": 0.1},
            0.3,
            {"_target_": f"{RULES}.ClippedSurrogate", "clip": 0.1, "deviation": 0.3},
        ),
        ({"actor_rule": "nope"}, 0.0, "nope"),
    ],
)
def test_actor_rules(loss, noise, rule):
    new = upgraded({"loss": {**loss, "exploration_noise": noise}, "collector": {"exploration_noise": noise}})
    assert new["loss"] == {"actor_rule": rule}


def test_stages():
    """A stage holds only the settings that it changes, and its schedule counts the updates of the run."""
    schedule = {"_target_": "pirl_rl.schedules.LossSchedule", "center": 2.0, "steepness": 3.0}
    linear = {"_target_": "pirl_rl.schedules.LinearSchedule", "start": 0.5, "end": 1.0}
    stages = [
        {"updates": 2, "schedule": schedule},
        {"updates": 1, "model_steps": 8},
        {"updates": 1, "exploration_noise": 0.1, "schedule": linear},
        {"updates": 1, "actor_rule": "ppo", "exploration_noise": 0.1},
        {"updates": 3, "actor_rule": "model"},
    ]
    config = {"loss": {"actor_rule": "model", "model_steps": 3}, "trainer": {"updates": 400}, "stages": stages}
    new = upgraded(config)["stages"]
    stretched = {**schedule, "center": 100.0, "steepness": 0.06}
    assert new[0]["schedule"] == stretched
    for unit in (0.0, 1.7, 2.0):  # the same weights at the same place of the stage
        before, after = (
            1 / (1 + math.exp(-one["steepness"] * (at - one["center"])))
            for one, at in ((schedule, unit), (new[0]["schedule"], 50 * unit))
        )
        assert after == pytest.approx(before, rel=1e-12)
    assert new[1] == {"share": 1, "actor_rule": {"_target_": f"{RULES}.LookAhead", "steps": 8}}
    assert new[2] == {"share": 1, "exploration_noise": 0.1, "schedule": {**linear, "start": 25.0, "end": 50.0}}
    assert new[3]["actor_rule"] == {"_target_": f"{RULES}.ClippedSurrogate", "clip": 0.2, "deviation": 0.1}
    assert new[4] == {"share": 3, "actor_rule": {"_target_": f"{RULES}.LookAhead", "steps": 3}}


@pytest.fixture
def older(tmp_path):
    """A run directory of format 1."""
    path = RunDirectory(tmp_path).config
    path.parent.mkdir()
    path.write_bytes(REACH1D.read_bytes())
    return tmp_path


def test_an_older_directory_opens_with_its_references(older):
    config = load_config(older)
    assert config.loss.actor_rule == HAMILTONIAN
    assert config.evaluation.simulator.dt == 0.1
    config.compile, config.env.dt = True, 0.05
    assert config.learner.compile is True
    assert config.evaluation.simulator.dt == 0.05
    assert config.evaluation.success.initial_states == config.env.initial_states


def test_what_is_saved_has_the_present_format(older):
    config = load_config(older)
    save_config(config, older)
    assert OmegaConf.load(RunDirectory(older).config).format == FORMAT
    assert load_config(older) == config


@pytest.mark.parametrize("number", [FORMAT + 1, "new"])
def test_a_later_format_is_refused(number, older):
    path = RunDirectory(older).config
    path.write_text(f"format: {number}\n{path.read_text()}")
    with pytest.raises(ConfigError, match=f"expected format 1 to {FORMAT}, got {number}"):
        load_config(older)
