"""The Gymnasium view: the checker of the library, registered names, the episodes of the environment, and filters."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import pirl_rl.problems
from pirl_rl import ReachAvoidFilter
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.grid import GridSolver
from pirl_rl.problems import DubinsCar, Exit1D, HalfSpace, Reach1D
from pirl_rl.simulator import Simulator
from pirl_rl.time_steps import propose_time_steps

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils import env_checker  # noqa: E402

from pirl_rl.gymnasium import (  # noqa: E402
    FilteredGym,
    FilteredVectorGym,
    ReachAvoidGym,
    ReachAvoidVectorGym,
    observation,
)

SHIPPED = pirl_rl.problems.__all__


def coarse(name: str) -> dict:
    """Few time steps, which take less time to choose than those that are proposed."""
    return {"dt": getattr(pirl_rl.problems, name).horizon / 10, "substeps": 1}


@pytest.mark.parametrize("name", SHIPPED)
def test_the_checker_of_the_library_finds_no_fault(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # The state is not bounded, and the library would have it so.
        warnings.filterwarnings("ignore", message=".*Box observation space (minimum|maximum) value is -?infinity.*")
        env = gymnasium.make(f"pirl_rl/{name}-v0", **coarse(name)).unwrapped
        assert isinstance(env, ReachAvoidGym)
        env_checker.check_env(env, skip_render_check=True)


@pytest.mark.parametrize("name", SHIPPED)
def test_vectors_keep_to_the_interface_of_the_library(name):
    """The library has no checker of vectors: spaces, kinds of results, seeds, and a wrapper of its own are tested."""
    pair = [gymnasium.make_vec(f"pirl_rl/{name}-v0", num_envs=6, **coarse(name)) for _ in range(2)]
    recorded = gymnasium.wrappers.vector.RecordEpisodeStatistics(pair[0])
    assert isinstance(pair[0].unwrapped, ReachAvoidVectorGym)
    assert pair[0].num_envs == 6
    assert pair[0].metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP
    first, other = (env.reset(seed=4)[0] for env in (recorded, pair[1]))
    assert np.array_equal(first, other)
    recorded.action_space.seed(0)
    ends = 0
    for _ in range(12):
        actions = recorded.action_space.sample()
        seen, reward, ended, cut, _ = recorded.step(actions)
        assert np.array_equal(seen, pair[1].step(actions)[0])
        assert recorded.observation_space.contains(seen)
        assert (reward.shape, reward.dtype, ended.shape, ended.dtype, cut.any()) == ((6,), float, (6,), bool, False)
        ends += ended.sum()
    assert len(recorded.return_queue) == ends > 0


def test_a_registered_environment_has_the_proposed_time_steps():
    proposed = propose_time_steps(HalfSpace())
    for env in (gymnasium.make("pirl_rl/HalfSpace-v0").unwrapped.paths, gymnasium.make_vec("pirl_rl/HalfSpace-v0", 2)):
        simulator = env.unwrapped.env.simulator
        assert (simulator.dt, simulator.substeps) == (proposed.dt, proposed.substeps)
    finer = gymnasium.make("pirl_rl/HalfSpace-v0", substeps=8).unwrapped.paths.env.simulator
    assert (finer.dt, finer.substeps) == (proposed.dt, 8)


def test_a_problem_with_other_arguments_takes_the_place_of_the_registered_one():
    env = gymnasium.make("pirl_rl/HalfSpace-v0", problem=HalfSpace(dim=5), dt=0.1, substeps=1)
    assert env.action_space.shape == (5,)


@pytest.fixture(scope="module")
def exit_filter() -> ReachAvoidFilter:
    """A filter by the grid's solution of the exit from an interval, whose best control is 1."""
    solution = GridSolver(Exit1D(), 41).solve()
    return ReachAvoidFilter(solution, p=0.6, mode="least_restrictive", simulator=Simulator(Exit1D(), 0.1))


def test_a_filter_corrects_the_actions_and_says_so(exit_filter):
    """The action -1 becomes 1 where the filter intervenes, for one path and for many alike."""
    env = FilteredGym(gymnasium.make("pirl_rl/Exit1D-v0", dt=0.1, substeps=1), exit_filter)
    env.reset(seed=1)
    counts = {True: 0, False: 0}
    for _ in range(60):
        tau, x = env.unwrapped.paths.time_and_state
        expected = bool(exit_filter.correct(tau, x, -torch.ones(1, 1))[1])
        _, _, ended, _, info = env.step(np.array([-1.0], np.float32))
        assert info["intervened"] is expected
        assert info["action"] == pytest.approx([1.0 if expected else -1.0], abs=1e-6)
        counts[expected] += 1
        if ended:
            env.reset()
    assert min(counts.values()) > 3
    paths = FilteredVectorGym(gymnasium.make_vec("pirl_rl/Exit1D-v0", 50, dt=0.1, substeps=1), exit_filter)
    paths.reset(seed=2)
    expected = exit_filter.correct(*paths.unwrapped.time_and_state, -torch.ones(50, 1))[1].numpy()
    infos = paths.step(-np.ones((50, 1), np.float32))[-1]
    assert np.array_equal(infos["intervened"], expected)
    assert 0 < expected.sum() < 50
    assert infos["action"][:, 0] == pytest.approx(np.where(expected, 1.0, -1.0), abs=1e-6)


def test_wrappers_of_actions_go_around_a_filter(exit_filter):
    """Outside, the action 0 of [0, 1] is the control -1; inside, the filter would read it as the control 0."""
    plain = gymnasium.make("pirl_rl/Exit1D-v0", dt=0.1, substeps=1)
    outside = gymnasium.wrappers.RescaleAction(FilteredGym(plain, exit_filter), np.float32(0.0), np.float32(1.0))
    outside.reset(seed=1)
    refused = bool(exit_filter.correct(*plain.unwrapped.paths.time_and_state, -torch.ones(1, 1))[1])
    info = outside.step(np.zeros(1, np.float32))[-1]
    assert info["action"] == pytest.approx([1.0 if refused else -1.0], abs=1e-6)
    with pytest.raises(ArgumentError, match="no wrapper inside the filter that changes actions, got RescaleAction"):
        FilteredGym(gymnasium.wrappers.RescaleAction(plain, np.float32(0.0), np.float32(1.0)), exit_filter)
    many = gymnasium.make_vec("pirl_rl/Exit1D-v0", 5, dt=0.1, substeps=1)
    with pytest.raises(ArgumentError, match="no wrapper inside the filter that changes actions, got ClipAction"):
        FilteredVectorGym(gymnasium.wrappers.vector.ClipAction(many), exit_filter)
    FilteredVectorGym(gymnasium.wrappers.vector.RecordEpisodeStatistics(many), exit_filter)


def test_a_filter_belongs_to_the_problem_of_its_environment(exit_filter):
    with pytest.raises(ArgumentError, match="reach_avoid_filter: expected one of the problem Reach1D, got Exit1D"):
        FilteredGym(ReachAvoidGym(Reach1D(), dt=0.1), exit_filter)
    with pytest.raises(ArgumentError, match="env: expected a ReachAvoidGym, got a CartPoleEnv"):
        FilteredGym(gymnasium.make("CartPole-v1"), exit_filter)


def test_ppo_of_another_library_trains_on_a_registered_environment(exit_filter):
    """A short rollout, without and with a filter; whether it learns is a test of the rivals."""
    library = pytest.importorskip("stable_baselines3")
    plain = gymnasium.make("pirl_rl/Exit1D-v0", dt=0.1, substeps=1)
    for env in (plain, FilteredGym(plain, exit_filter)):
        model = library.PPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0, device="cpu")
        before = [entry.clone() for entry in model.policy.parameters()]
        model.learn(64)
        assert model.num_timesteps == 64
        assert any(not torch.equal(old, new) for old, new in zip(before, model.policy.parameters(), strict=True))


def test_an_observation_is_scaled_and_angles_are_periodic():
    problem = DubinsCar()
    low, high = (torch.tensor([corner]) for corner in (problem.states.low, problem.states.high))
    ends = observation(problem, torch.tensor([0.0]), low), observation(problem, torch.tensor([problem.horizon]), high)
    assert ends[0][0, :3].tolist() == pytest.approx([-1, -1, -1])
    assert ends[1][0, :3].tolist() == pytest.approx([1, 1, 1])
    assert torch.allclose(ends[0][:, 3:], ends[1][:, 3:], atol=1e-6)


def test_paths_are_those_of_the_environment():
    """Observations, rewards and ends of 30 steps, with the same seed and actions."""
    problem = Reach1D()
    views, paths = (ReachAvoidEnv(problem, 0.1, num_envs=20, seed=3) for _ in range(2))
    vector = ReachAvoidVectorGym(views)
    seen, state = vector.reset()[0], paths.reset()
    for index in range(30):
        assert np.allclose(seen, observation(problem, state["tau"][:, 0], state["state"]).numpy())
        action = np.full((20, 1), np.sin(index), np.float32)
        seen, reward, ended, cut, infos = vector.step(action)
        done, state = paths.step_and_maybe_reset(state.set("action", torch.as_tensor(action)))
        assert np.allclose(reward, done["next", "reward"][:, 0].numpy())
        assert np.array_equal(ended, done["next", "done"][:, 0].numpy())
        assert not cut.any()
        if ended.any():
            last = observation(problem, done["next", "tau"][:, 0], done["next", "state"]).numpy()
            assert np.allclose(infos["final_obs"][ended], last[ended])


def test_the_return_is_the_probability_of_success():
    """4,000 episodes from one state under u = -1, within four standard errors of the simulator's own estimate."""
    problem, x = Reach1D(), torch.full((4_000, 1), 0.5)
    env = ReachAvoidEnv(problem, 0.1, num_envs=4_000, seed=0)
    vector = ReachAvoidVectorGym(env)
    vector.reset(seed=1)
    vector._state = env.reset().set("state", x).set("tau", torch.full((4_000, 1), 1.0))
    total, running = np.zeros(4_000), np.ones(4_000, bool)
    for _ in range(10):
        _, reward, ended, _, _ = vector.step(-np.ones((4_000, 1), np.float32))
        total += reward * running
        running &= ~ended
    expected = mean_payoff(
        Simulator(problem, 0.1), lambda tau, x: -torch.ones_like(x), torch.ones(1), x[:1], 20_000, torch.Generator()
    )
    assert not running.any()
    assert total.mean() == pytest.approx(expected.item(), abs=4 * 0.5 / 4_000**0.5)


def test_a_seed_fixes_the_episodes():
    one, other = (ReachAvoidGym(Reach1D(), dt=0.1) for _ in range(2))
    assert np.array_equal(one.reset(seed=5)[0], other.reset(seed=5)[0])
    for _ in range(20):
        first, second = (env.step(np.array([0.3], np.float32)) for env in (one, other))
        assert np.array_equal(first[0], second[0])
        if first[2]:
            break
