"""The Gymnasium view: the library's own checker, the same episodes as the environment, and seeds."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.problems import DoubleIntegrator, DubinsCar, Reach1D
from pirl_rl.simulator import Simulator

env_checker = pytest.importorskip("gymnasium.utils.env_checker")
from pirl_rl.gymnasium import ReachAvoidGym, ReachAvoidVectorGym, observation  # noqa: E402


@pytest.mark.parametrize("problem", [Reach1D(), DoubleIntegrator(), DubinsCar()])
def test_the_checker_of_the_library_finds_no_fault(problem):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # The state is not bounded, and the library would have it so.
        warnings.filterwarnings("ignore", message=".*Box observation space (minimum|maximum) value is -?infinity.*")
        env_checker.check_env(ReachAvoidGym(problem, dt=problem.horizon / 10), skip_render_check=True)


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
