"""The environment: specs, resets, whole steps to go, rewards and ends."""

from __future__ import annotations

import pytest
import torch
from oracles import PROBLEMS, FullNoise, name
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.payoffs import SmoothPayoff
from pirl_rl.problems import Reach1D, Safety1D
from pirl_rl.problems.reach1d_env import Reach1DEnv
from pirl_rl.sampling.initial_states import UniformStates


def step(env, state, tau, action):
    """One step of every environment from given states, without a reset."""
    td = TensorDict({"state": state, "tau": tau, "action": action}, batch_size=env.batch_size)
    return env.step(td)["next"]


def at(env, state: float, tau: float, action: float = 1.0):
    rows = torch.ones(*env.batch_size, 1)
    return step(env, state * rows, tau * rows, action * rows)


@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_specs(problem):
    check_env_specs(ReachAvoidEnv(problem, num_envs=8, seed=0))


@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_same_seed_same_episodes(problem):
    def episode(seed):
        env = ReachAvoidEnv(problem, num_envs=16, seed=seed)
        return env.rollout(
            5, lambda td: td.set("action", torch.zeros(env.action_spec.shape)), break_when_any_done=False
        )

    first, second, other = episode(4), episode(4), episode(5)
    assert (first == second).all()
    assert not torch.equal(first["state"], other["state"])


def test_set_seed_restarts_the_stream():
    env = Reach1DEnv(num_envs=16, seed=1)
    first = env.reset()["state"]
    env.set_seed(1)
    assert torch.equal(env.reset()["state"], first)


def test_the_stream_is_its_own():
    env = Reach1DEnv(num_envs=16, seed=1)
    torch.manual_seed(0)
    before = torch.get_rng_state()
    at(env, 0.0, 1.0)
    env.reset()
    assert torch.equal(torch.get_rng_state(), before)


def test_partial_reset_leaves_the_others_alone():
    env = Reach1DEnv(num_envs=32, seed=0)
    td = env.rand_step(env.reset())["next"]
    chosen = (torch.arange(32) % 3 == 0).unsqueeze(-1)
    td["_reset"] = chosen
    kept = td.clone()
    fresh = env.reset(td)
    for key in ("state", "tau"):
        assert torch.equal(fresh[key][~chosen], kept[key][~chosen])
    assert (fresh["state"][chosen] != kept["state"][chosen]).all()
    assert not fresh["terminated"][chosen].any()


def test_starts_are_drawn_many_at_a_time_and_each_is_played_once():
    """A draw along a rollout sees the states of the paths that go on, which TorchRL by itself would hide."""
    draws = []

    class Recording(UniformStates):
        def sample(self, problem, count, max_steps, rng, dtype, visited=None):
            draws.append((count, visited, super().sample(problem, count, max_steps, rng, dtype, visited)))
            return draws[-1][-1]

    env = Reach1DEnv(num_envs=64, seed=0, initial_states=Recording())
    td = env.reset()
    assert [draw[:2] for draw in draws] == [(64, None)]
    left = 0
    for _ in range(20):
        known = len(draws)
        stepped, td = env.step_and_maybe_reset(env.rand_action(td))
        ended = stepped["next", "done"].squeeze(-1)
        if len(draws) > known:
            count, visited, _ = draws[-1]
            assert len(draws) == known + 1
            assert left < int(ended.sum())
            assert count == 64
            assert torch.equal(visited, stepped["next", "state"][~ended])
            left = 64
        first = 64 - left
        left -= int(ended.sum())
        steps, states = (entry[first : 64 - left] for entry in draws[-1][-1])
        assert torch.equal(td["state"][ended], states)
        assert torch.equal(td["tau"][ended].squeeze(-1), env.simulator.clock.time(steps).to(td["tau"]))
        assert torch.equal(td["state"][~ended], stepped["next", "state"][~ended])
    assert len(draws) > 3


def test_a_seed_and_another_distribution_drop_what_is_left_of_a_draw():
    env = Reach1DEnv(num_envs=64, seed=0)
    first = env.reset().set("action", torch.zeros(64, 1))

    def played():
        env.set_seed(5)
        td, states = first, []
        for _ in range(10):
            td = env.step_and_maybe_reset(td.clone())[1].set("action", torch.zeros(64, 1))
            states.append(td["state"])
        return torch.stack(states)

    assert torch.equal(played(), played())
    env.initial_states = UniformStates(low=[0.3], high=[0.31])
    for _ in range(10):
        td = env.step_and_maybe_reset(env.rand_action(env.reset()))[1]
        started = td["state"][td["is_init"].squeeze(-1)]
        assert ((started >= 0.3) & (started <= 0.31)).all()


def test_is_init_marks_first_states_alone():
    env = Reach1DEnv(num_envs=256, seed=0)
    td, ends = env.reset(), 0
    assert td["is_init"].all()
    for _ in range(8):
        stepped, td = env.step_and_maybe_reset(env.rand_action(td))
        assert not stepped["next", "is_init"].any()
        assert torch.equal(td["is_init"], stepped["next", "done"])
        ends += int(td["is_init"].sum())
    assert ends > 100


@pytest.mark.parametrize(("dt", "steps"), [(0.1, 20), (0.2, 10), (0.02, 100)])
def test_an_episode_over_the_horizon_has_whole_steps(dt, steps):
    """In float32, far from the target: rounding neither adds nor drops one."""
    env = Reach1DEnv(dt=dt, num_envs=4, seed=0, initial_states=UniformStates([-60.0], [-50.0], tau="fixed"))
    td, rows = env.reset(), 0
    assert torch.allclose(td["tau"], torch.full((4, 1), steps * dt))
    while True:
        td["action"] = torch.zeros(4, 1)
        td = env.step(td)["next"]
        rows += 1
        if td["terminated"].any():
            break
        assert torch.allclose(td["tau"], torch.full((4, 1), (steps - rows) * dt), atol=1e-5)
    assert rows == steps
    assert td["terminated"].all()
    assert (td["tau"] == 0).all()
    assert (td["reward"] == 0).all()


def test_random_tau_is_a_whole_number_of_steps_and_ends_on_time():
    env = Reach1DEnv(num_envs=4096, seed=0)
    td = env.reset()
    steps = torch.round(td["tau"] / 0.1)
    assert torch.allclose(td["tau"], 0.1 * steps)
    assert steps.unique().tolist() == list(range(1, 21))
    td["action"] = torch.zeros_like(td["tau"])
    following = env.step(td)["next"]
    assert following["terminated"][steps == 1].all()
    survived = ~following["terminated"]
    assert (following["state"][survived] < 2).all()


def test_success_pays_one_and_ends():
    """From next to the target and from beyond any chance of it."""
    env = Reach1DEnv(num_envs=4096, seed=0)
    near = at(env, 1.99, 1.0)
    assert torch.equal(near["terminated"], near["reward"] == 1)
    assert torch.equal(near["terminated"], near["done"])
    assert set(near["reward"].unique().tolist()) == {0.0, 1.0}
    assert near["terminated"][near["state"] >= 2].all()
    far = at(env, -20.0, 1.0)
    assert not far["terminated"].any()
    assert (far["reward"] == 0).all()
    assert (at(env, -20.0, 0.1)["reward"] == 0).all()


def test_failure_pays_nothing_and_ends():
    env = ReachAvoidEnv(FullNoise(1, 1, 2), num_envs=4096, seed=0)
    following = at(env, -0.79, 1.0, 0.0)
    lost = following["state"] <= -0.8
    assert 0.2 < lost.float().mean() < 0.8
    assert following["terminated"][lost].all()
    assert (following["reward"][lost] == 0).all()


def test_invariance_pays_survival_at_the_horizon():
    env = ReachAvoidEnv(Safety1D(), dt=0.1, num_envs=4096, seed=0)
    early, last = at(env, 0.7, 1.0, 0.0), at(env, 0.7, 0.1, 0.0)
    assert (early["reward"] == 0).all()
    assert early["terminated"][early["state"].abs() >= 1].all()
    assert not early["terminated"].all()
    assert last["terminated"].all()
    assert (last["reward"][last["state"].abs() >= 1] == 0).all()
    # The bridge also ends paths that touched a face and came back.
    survived = (last["reward"] == 1).float().mean().item()
    assert (last["state"].abs() < 1).float().mean().item() > survived > 0.4


def test_a_smoothed_payoff_pays_its_value_at_the_horizon():
    problem = Reach1D(payoff=SmoothPayoff(0.5))
    env = ReachAvoidEnv(problem, num_envs=4096, seed=0)
    last = at(env, 2.2, 0.1, 0.0)
    reached = last["reward"] == 1
    assert last["terminated"].all()
    assert reached[last["state"] >= 2.5].all()
    partial = last["reward"][~reached]
    torch.testing.assert_close(partial, problem.payoff(2 - last["state"][~reached]))
    assert ((partial > 0) & (partial < 1)).any()


def test_the_action_is_the_normalised_control():
    """Mean displacement of a step is f(x, u) dt with u = denormalised action; five standard errors."""
    env = ReachAvoidEnv(Reach1D(), num_envs=20_000, seed=0)
    for action in (-1.0, 0.5):
        moved = at(env, -20.0, 1.0, action)["state"].mean().item() + 20
        assert moved == pytest.approx(0.1 * action, abs=5 * (0.1 / 20_000) ** 0.5)
    problem = FullNoise(1, 1, 2)
    assert problem.controls.denormalize(torch.tensor([-1.0, 1.0]).unsqueeze(-1)).squeeze(-1).tolist() == [-0.5, 1.5]


def test_a_given_state_can_be_set():
    env = Reach1DEnv(num_envs=3, seed=0)
    start = TensorDict({"state": torch.tensor([[-1.0], [0.0], [1.0]]), "tau": torch.full((3, 1), 0.5)}, batch_size=[3])
    td = env.reset(start, set_state=True)
    assert torch.equal(td["state"], start["state"])
    assert torch.equal(td["tau"], start["tau"])


@pytest.mark.parametrize("kwargs", [{"dt": 3.0}, {"num_envs": 0}, {"num_envs": 2.5}, {"crossing": "never"}])
def test_wrong_arguments_are_named(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        Reach1DEnv(**kwargs)
