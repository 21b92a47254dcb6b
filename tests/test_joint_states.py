"""Initial states of several trainings, drawn together, each training with its own V."""

from __future__ import annotations

import pytest
import torch
from small import DRIFT, QUICK, small_trainer

from pirl_rl.collectors import joint_states
from pirl_rl.collectors.joint_states import JointStates, together
from pirl_rl.problems import Reach1D
from pirl_rl.sampling.initial_states import UniformStates, VisitedStates
from pirl_rl.sampling.undecided import UndecidedStates
from pirl_rl.simulator import Simulator


def trainers(folder, base=QUICK):
    return [small_trainer(folder / str(seed), "compile=false", f"seed={seed}", base=base) for seed in range(3)]


@pytest.mark.parametrize("base", [QUICK, DRIFT], ids=["reach1d", "drift"])
def test_each_training_has_the_value_of_its_networks(base, tmp_path):
    members = trainers(tmp_path, base)
    values: list = []
    assert together([member.collector.initial_states for member in members], values) is not None
    (joint,) = values
    problem, rng = members[0].solution.problem, torch.Generator().manual_seed(0)
    x, tau = problem.states.sample(3 * 200, rng), problem.horizon * torch.rand(3 * 200, generator=rng)
    for changed in (False, True):
        if changed:
            torch.nn.init.normal_(next(members[1].solution.critic.parameters()))
            joint.gather()
        expected = [one.solution.value(t, y) for one, t, y in zip(members, tau.chunk(3), x.chunk(3), strict=True)]
        torch.testing.assert_close(joint.value(tau, x), torch.cat(expected), rtol=1e-4, atol=1e-5)
        assert not torch.allclose(expected[0], expected[1], atol=1e-3)
        expected = [one.solution.residual(t, y) for one, t, y in zip(members, tau.chunk(3), x.chunk(3), strict=True)]
        found, scale = joint.residual(tau, x), torch.cat(expected).abs().max().item()
        torch.testing.assert_close(found, torch.cat(expected), rtol=1e-4, atol=1e-5 * scale)


class Halves:
    """V = 1/2 for the first training where x < 0 and for the second where x > 0, else 1."""

    def value(self, tau, x):
        sign = torch.tensor([-1.0, 1.0]).repeat_interleave(len(x) // 2)
        return torch.where(x[:, 0] * sign > 0, 0.5, 1.0)


def test_groups_are_drawn_by_their_own_weights():
    """Half of the candidates has the weight 1, the others 0.25: with many candidates 4 of 5 are undecided.

    Without replacement the share is smaller by less than 0.01 with 50 candidates for each state.
    """
    law = UndecidedStates(UniformStates([-1.0], [1.0]), Halves(), Simulator(Reach1D(), 0.1), 0.25, 50)
    law.groups = 2
    steps, x = law.sample(Reach1D(), 4_000, 20, torch.Generator().manual_seed(0), torch.float32)
    assert (steps.shape, x.shape) == ((4_000,), (4_000, 1))
    below = (x[:, 0] < 0).double().reshape(2, -1).mean(1)
    assert below.tolist() == pytest.approx([0.8, 0.2], abs=0.01 + 4 * (0.16 / 2_000) ** 0.5)


def test_trainings_that_draw_together_leave_the_compiled_residual_of_the_first_one(tmp_path, monkeypatch):
    said, values = [], []
    monkeypatch.setattr("pirl_rl.compilation.announce", said.append)
    members, simulator = trainers(tmp_path), Simulator(Reach1D(), 0.1)
    laws = [UndecidedStates(UniformStates(), one.solution, simulator, gain=1.0, compile=True) for one in members]
    rng = torch.Generator().manual_seed(0)
    joint = together(laws, values)
    assert joint is not None
    joint.sample(Reach1D(), 30, 20, rng, torch.float32)
    assert said == []
    laws[0].sample(Reach1D(), 30, 20, rng, torch.float32)
    assert said == ["compiling the residual of V at initial states"]


@pytest.mark.parametrize("drawn", [2**18, 30])
def test_states_are_in_the_order_of_the_trainings(drawn, monkeypatch, tmp_path):
    """With one training whose V is 1/2 left of 0 and with another one for which that is so on the right."""
    monkeypatch.setattr(joint_states, "DRAWN", drawn)
    members = trainers(tmp_path)
    envs = [member.collector.env for member in members]
    states = JointStates(envs)
    states._enter()
    assert states._together is not None
    monkeypatch.setattr(joint_states.JointValue, "value", lambda self, tau, x: _by_training(x))
    monkeypatch.setattr(joint_states.JointValue, "residual", lambda self, tau, x: torch.zeros_like(tau))
    problem, rng = envs[0].problem, torch.Generator().manual_seed(0)
    steps, x = states.sample(problem, 3 * 1_000, envs[0].max_steps, rng, torch.float32)
    assert (steps.shape, x.shape) == ((3_000,), (3_000, 1))
    assert steps.min() >= 1
    assert problem.interior(x).all()
    below = (x[:, 0] < 0).double().reshape(3, -1).mean(1)
    assert below[0] > below[1] + 0.1
    assert below[2] < below[1] - 0.1


def _by_training(x):
    first, second, third = x[:, 0].chunk(3)
    return torch.cat([torch.where(first < 0, 0.5, 1.0), torch.ones_like(second), torch.where(third > 0, 0.5, 1.0)])


def test_distributions_that_differ_by_more_are_drawn_one_after_another(tmp_path):
    members = trainers(tmp_path)
    envs = [member.collector.env for member in members]
    for env, shift in zip(envs, (-1.5, -1.0, -0.5), strict=True):
        env.initial_states = VisitedStates(UniformStates([shift], [shift + 0.1]), share=0.0)
    states = JointStates(envs)
    _, x = states.sample(envs[0].problem, 3 * 50, 10, torch.Generator().manual_seed(0), torch.float32)
    for part, low in zip(x.chunk(3), (-1.5, -1.0, -0.5), strict=True):
        assert ((part >= low) & (part <= low + 0.1)).all()
