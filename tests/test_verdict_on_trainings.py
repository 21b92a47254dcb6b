"""The verdict on trainings that were spoilt, of Zermelo's boat: none is called solved, and the sound one is."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch

import pirl_rl
from pirl_rl.errors import ProblemError
from pirl_rl.evaluation import Verdict, statements_of
from pirl_rl.problems import ZermeloBoat
from pirl_rl.runs.run import Run
from pirl_rl.simulator import Simulator

pytestmark = pytest.mark.slow

NOTHING = {"evaluation.during": [], "evaluation.final": [], "evaluate_every": 0}
UPDATES = 10_500
"""The length of a training by the default recipe."""


class FarLanding(ZermeloBoat):
    landing = (40.0, 0.0)


class HiddenLanding(ZermeloBoat):
    """A thin target whose level has no slope, so that neither sampling nor descent finds it."""

    def target_level(self, x):
        return ((x - x.new_tensor(self.landing)).norm(dim=-1) > 1e-4).to(x) - 0.5


class OutOfReach(ZermeloBoat):
    """The landing lies just outside the box of states, where the river has no bank, behind the strongest current."""

    current = 30.0
    landing = (-2.2, 0.0)
    limits = (4.0, 1.0)


class MoreNoise(ZermeloBoat):
    noise = (0.9, 0.9)


def verdict(run: Run, simulator: Simulator | None = None) -> tuple[str, str]:
    evidence = {"verdict": Verdict()(run.solution, simulator or run.simulator)}
    statements = statements_of(evidence)
    print("\n".join(evidence["verdict"].lines()))
    return statements["verdict"], statements["verdict_reason"]


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """A training by the default recipe, with the networks after each hundredth of it."""
    folder = tmp_path_factory.mktemp("sound") / "run"
    pirl_rl.train("zermelo", folder=folder, seed=20, checkpoint_every=UPDATES // 100, **NOTHING)
    return folder


def test_a_sound_training_is_solved(sound):
    assert verdict(pirl_rl.load_run(sound))[0] == "solved"


TRAININGS = {
    "an actor that does not learn": ({"pirl.stages": [{"share": 1, "train_actor": False}]}, "succeeds more often"),
    "time steps ten times as long": ({"env.dt": 0.1, "env.substeps": 1}, "With shorter time steps"),
    "a weight of the residual that collapses V": ({"pirl.final": [1, 1_000, 0], "schedule.center": 0.1}, "V is "),
    "a hundredth of the updates": ({"updates": UPDATES // 100}, "V is wrong by"),
    "a rate that is far too low": ({"learner.learning_rate": 1e-5}, "succeeds more often"),
}


@pytest.mark.parametrize("name", TRAININGS)
def test_a_spoilt_training_is_not_solved(name, tmp_path):
    settings, reason = TRAININGS[name]
    level, why = verdict(pirl_rl.train("zermelo", folder=tmp_path / "run", seed=20, **NOTHING | settings))
    assert level in ("doubtful", "failed")
    assert reason in why


def test_a_training_that_was_cut_at_a_hundredth_is_not_solved(sound):
    level, why = verdict(pirl_rl.load_run(sound, weights=f"weights-{UPDATES // 100:09d}.pt"))
    assert level in ("doubtful", "failed")
    assert "V is wrong by" in why


def test_a_training_with_noise_of_the_wrong_size_is_not_solved(sound):
    run = pirl_rl.load_run(sound, problem=MoreNoise())
    level, why = verdict(run)
    assert level in ("doubtful", "failed")
    assert "V is wrong by" in why


def test_a_target_out_of_reach_is_not_solved(tmp_path):
    run = pirl_rl.train(OutOfReach, folder=tmp_path / "run", updates=1_000, **NOTHING)
    level, why = verdict(run)
    assert level == "failed"
    assert "never reaches the target, nor does a random or a constant control" in why


@pytest.mark.parametrize("problem", [FarLanding, HiddenLanding])
def test_a_target_that_is_not_found_is_not_trained(problem, tmp_path):
    with pytest.raises(ProblemError, match=r"target_level .*: no point of the target was found"):
        pirl_rl.train(problem, folder=tmp_path / "run", **NOTHING)


def with_last_layer(run: Run, factor: float, shift: float) -> Run:
    """A run whose actor has another last layer: weights times a factor, and biases plus a shift."""
    actor = copy.deepcopy(run.solution.actor)
    last = [layer for layer in actor.modules() if isinstance(layer, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight.mul_(factor)
        last.bias.mul_(factor).add_(shift)
    run.solution.actor = actor
    return run


@pytest.mark.parametrize(("factor", "shift"), [(-1.0, 0.0), (1.0, 50.0)], ids=["reversed", "saturated"])
def test_a_spoilt_policy_is_not_solved(factor, shift, sound):
    level, why = verdict(with_last_layer(pirl_rl.load_run(sound), factor, shift))
    assert level == "failed"
    assert "succeeds more often" in why or "V is wrong by" in why


def test_a_value_that_was_raised_is_not_solved(sound):
    run = pirl_rl.load_run(sound)
    value = run.solution.value
    run.solution.value = lambda tau, x: value(tau, x) + 0.1
    level, why = verdict(run)
    assert level in ("doubtful", "failed")
    assert "V is wrong by" in why
    assert "above Monte Carlo" in why
