"""Run directories of the first format open through the table of renames and say what they said then.

`data/format1_answers.npz` holds values and controls of `data/format1` and `data/format1_drift` at 64 points each,
computed by the version that wrote these directories.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

import pirl_rl
from pirl_rl.assembly import make_trainer
from pirl_rl.configuration import load_config
from pirl_rl.run_directory import RunDirectory

DATA = Path(__file__).parent / "data"
FOLDERS = {"reach1d": DATA / "format1", "drift": DATA / "format1_drift"}
ROUNDING = 1e-6
"""Relative to the largest entry: single precision on another processor."""


@pytest.mark.parametrize("name", FOLDERS)
def test_values_and_controls_are_those_of_the_version_that_wrote_them(name):
    run = pirl_rl.load_run(FOLDERS[name])
    with np.load(DATA / "format1_answers.npz") as file:
        answers = {key.removeprefix(f"{name}_"): file[key] for key in file if key.startswith(f"{name}_")}
    assert answers["value"].std() > 0.3
    for key in ("value", "policy"):
        found = getattr(run, key)(answers["tau"], answers["x"])
        assert np.abs(found - answers[key]).max() <= ROUNDING * np.abs(answers[key]).max()


@pytest.mark.parametrize("name", FOLDERS)
def test_only_what_is_read_is_brought_up_to_date(name):
    """The file says no format, which means the first one, and names a rule by a word; what is read names its class."""
    written = yaml.safe_load(RunDirectory(FOLDERS[name]).config.read_text())
    assert "format" not in written
    assert isinstance(written["loss"]["actor_rule"], str)
    rule = {"reach1d": "Hamiltonian", "drift": "LookAhead"}[name]
    assert load_config(FOLDERS[name]).loss.actor_rule._target_ == f"pirl_rl.actor_rules.{rule}"


@pytest.mark.parametrize("name", FOLDERS)
def test_the_whole_configuration_builds(name):
    """The trainer with its evaluators and stages, so that a run of the first format can be resumed."""
    trainer = make_trainer(load_config(FOLDERS[name]))
    assert trainer.simulator.problem is trainer.solution.problem
    assert [stage.share for stage in trainer.curriculum.stages] == {"reach1d": [1.0], "drift": [8, 4, 5]}[name]
    assert {"success", "residuals", "calibration"} <= trainer.final.keys()


def test_a_new_run_starts_from_networks_of_the_first_format(tmp_path):
    settings = {"debug": "default", "logger": "none", "evaluate_every": 0, "learner.learning_rate": 1e-6}
    # The networks of the first format: two critics with linear outputs.
    settings |= {"recipe": "plain", "pirl": {"critics": 2, "td_criterion": "squares"}}
    run = pirl_rl.train("reach1d", folder=tmp_path / "run", start=str(FOLDERS["reach1d"]), updates=1, **settings)
    before = pirl_rl.load_run(FOLDERS["reach1d"])
    tau, x = np.full(9, 1.0), np.linspace(-2, 1.9, 9)[:, None]
    # One update of Adam moves each of some 5,000 weights by at most the learning rate.
    assert np.abs(run.value(tau, x) - before.value(tau, x)).max() < 1e-3
