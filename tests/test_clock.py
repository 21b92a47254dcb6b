"""The control steps of an episode, of simulated paths and of evaluators fill the time to go, also where dt does not."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from small import metrics
from tensordict import TensorDict

from pirl_rl.actor_rules import LookAhead
from pirl_rl.clock import Clock
from pirl_rl.collectors.transitions import Transitions
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.evaluation import Residuals
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.evaluation.trajectories import closed_loop
from pirl_rl.problems import Reach1D
from pirl_rl.sampling.initial_states import UniformStates
from pirl_rl.simulator import Simulator

STEPS = [(2.0, 0.3), (2.0, 1.3), (1.0, 0.7), (2.0, 2.0), (2.0, 0.1), (1.5, 0.02), (3.0, 0.0011), (0.7, 0.1)]


class Straight(Reach1D):
    """dx = dt, without noise and far from the target: the state counts the time that is played."""

    def drift(self, x, u):
        return torch.ones_like(x)

    def diffusion(self, x, u):
        return torch.zeros_like(x).unsqueeze(-1)


def forward(tau, x):
    """The best control of `Reach1D`."""
    return torch.ones_like(x)


def rng():
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("horizon", "dt"), STEPS)
def test_steps_fill_the_time_to_go(horizon, dt, dtype):
    """Any time to go: whole steps, then one of length in (0, dt], to the rounding of tau."""
    clock = Clock(dt, horizon)
    tau = torch.cat([torch.rand(200, generator=rng(), dtype=dtype), torch.ones(1, dtype=dtype)]) * horizon
    left, shortfall = clock.split(tau)
    played = torch.zeros(len(tau), dtype=torch.float64)
    assert (left >= 1).all()
    for _ in range(clock.max_steps):
        h = clock.length(left, shortfall)
        assert torch.equal(h[left > 1], torch.full_like(h[left > 1], dt))
        assert ((h > 0) & (h <= dt)).all()
        played, left = played + h * (left > 0), (left - 1).clamp(min=0)
        assert (clock.time(left, shortfall)[left == 0] == 0).all()
    assert (left == 0).all()
    rounding = 1e-4 * dt + 1e-6 * horizon
    assert (played - tau.double()).abs().max() <= rounding
    assert torch.equal(clock.split(torch.zeros(3, dtype=dtype))[0], torch.zeros(3, dtype=torch.int64))


@pytest.mark.parametrize(("horizon", "dt"), STEPS)
def test_rounding_adds_no_step(horizon, dt):
    """Times to go of an episode from the horizon, in single precision."""
    clock = Clock(dt, horizon)
    steps = torch.arange(1, clock.max_steps + 1)
    tau = clock.time(steps)
    assert tau.dtype == torch.float32
    assert tau[-1].item() == pytest.approx(horizon, rel=1e-6)
    again, shortfall = clock.split(tau)
    assert torch.equal(again, steps)
    torch.testing.assert_close(shortfall, torch.full_like(shortfall, clock.shortfall), rtol=0, atol=1e-6 * horizon)


@pytest.mark.parametrize(("horizon", "dt"), [(2.0, 0.1), (2.0, 0.3), (2.0, 1.3), (1.0, 0.7)])
def test_an_episode_starts_at_the_horizon_and_ends_at_zero(horizon, dt):
    starts = UniformStates([-60.0], [-50.0], tau="fixed")
    env = ReachAvoidEnv(Straight(horizon=horizon), dt, 3, initial_states=starts, num_envs=4, seed=0)
    td = env.reset()
    first, taus = td["state"], [td["tau"]]
    for _ in range(env.max_steps):
        td["action"] = torch.zeros(4, 1)
        td = env.step(td)["next"]
        taus.append(td["tau"])
        assert torch.equal(td["terminated"], td["tau"] == 0)
    assert td["terminated"].all()
    expected = [max(horizon - k * dt, 0) for k in range(env.max_steps)] + [0.0]
    torch.testing.assert_close(torch.stack(taus)[:, 0, 0], torch.tensor(expected), rtol=0, atol=1e-6)
    # Single precision at x = -60, over up to 60 sub-steps.
    torch.testing.assert_close(td["state"] - first, torch.full((4, 1), horizon), rtol=0, atol=2e-4)


def test_episodes_of_random_length_start_on_the_times_of_the_whole_one():
    env = ReachAvoidEnv(Reach1D(), 0.3, num_envs=2000, seed=0)
    tau = env.reset()["tau"]
    torch.testing.assert_close(tau.unique(), torch.tensor([0.2, 0.5, 0.8, 1.1, 1.4, 1.7, 2.0]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dt", [1.3, 0.3, 0.25])
def test_simulated_paths_take_the_time_to_go(dt):
    """The fault that is excluded: 2.6 s instead of 2 s at dt = 1.3, and 2.1 s at dt = 0.3."""
    tau = torch.tensor([2.0, 1.0, 0.1, 0.0], dtype=torch.float64)
    x = torch.full((4, 1), -50.0, dtype=torch.float64)
    paths = closed_loop(Simulator(Straight(), dt), forward, tau, x, rng())
    torch.testing.assert_close(paths.state[-1, :, 0] + 50, tau, rtol=0, atol=1e-6)
    torch.testing.assert_close(paths.state[:, :, 0] + 50 + paths.tau, tau.expand_as(paths.tau), rtol=0, atol=1e-6)
    assert (paths.tau[-1] == 0).all()
    assert torch.equal(paths.steps, torch.ceil(tau / dt).long())


def reach(dt: float, paths: int):
    """Shares of paths from x = 0 that reach within T = 2: episodes, simulated paths and `monte_carlo`."""
    problem, x = Reach1D(), torch.zeros(paths, 1)
    env = ReachAvoidEnv(problem, dt, initial_states=UniformStates([-1e-9], [0.0], tau="fixed"), num_envs=paths, seed=1)
    td, reward, alive = env.reset(), torch.zeros(paths, 1), torch.ones(paths, 1, dtype=torch.bool)
    for _ in range(env.max_steps):
        td["action"] = torch.ones(paths, 1)
        td = env.step(td)["next"]
        reward, alive = reward + alive * td["reward"], alive & ~td["terminated"]
    assert not alive.any()
    yield reward.mean().item()
    yield closed_loop(env.simulator, forward, torch.full((paths,), 2.0), x, rng()).reached.double().mean().item()
    yield float(monte_carlo(problem, forward, 2.0, x[:1], paths, dt=dt).probability)


def test_the_law_is_that_of_the_horizon():
    """Three standard errors; 2.1 s, to which dt = 0.3 would round, are more than ten away."""
    paths, at = 100_000, torch.zeros(1, 1, dtype=torch.float64)
    exact, rounded = (Reach1D().exact_value(torch.full((1,), time).double(), at).item() for time in (2.0, 2.1))
    error = (exact * (1 - exact) / paths) ** 0.5
    assert rounded - exact > 10 * error
    for share in reach(0.3, paths):
        assert abs(share - exact) <= 3 * error


def test_returns_of_several_steps_cross_the_shortened_step():
    """Three-step returns over episodes of up to 7 steps, the last of 0.2 s: "next" is 0.9 s later or at tau = 0, where
    the payoff is the reward.
    """
    env = ReachAvoidEnv(Straight(), 0.3, num_envs=64, seed=0)
    steps, td = [], env.reset()
    for _ in range(10):
        td["action"] = torch.zeros(64, 1)
        step, td = env.step_and_maybe_reset(td)
        steps.append(step)
    batch = torch.stack(steps, 1)
    batch = Transitions(3)(batch)
    tau, x, following = batch["tau"], batch["state"], batch["next"]
    inner = torch.arange(len(tau)) % 10 < 8
    end = (x + tau >= 2) & inner.unsqueeze(-1)
    late = inner.unsqueeze(-1) & (x + tau < 2)
    played = torch.minimum(tau, torch.full_like(tau, 0.9))
    assert (late & (tau < 0.9)).any()
    torch.testing.assert_close((following["state"] - x)[late], played[late], rtol=0, atol=1e-5)
    torch.testing.assert_close((tau - following["tau"])[late], played[late], rtol=0, atol=1e-5)
    assert torch.equal((following["tau"] == 0)[late], (tau < 0.95)[late])
    assert torch.equal(following["terminated"][late], (following["tau"] == 0)[late])
    assert (following["reward"][late] == 0).all()
    assert (following["reward"][end & (tau < 0.95)] == 1).all()


class Straightforward:
    """Stands for a `Solution` of `Straight` with its exact value: 1 if x + tau >= 2."""

    dtype, device, problem = torch.float64, torch.device("cpu"), Straight()

    def policy(self, tau, x):
        return forward(tau, x)

    def raw_value(self, tau, x):
        return (x[..., 0] + tau >= 2).double()

    def residual(self, tau, x, u=None):
        return torch.zeros_like(tau)

    def gradient(self, tau, x):
        return torch.zeros_like(x)


def test_held_out_transitions_have_the_lengths_of_the_steps():
    """The exact value has no one-step error; with whole steps throughout, that of the last would be about 0.003."""
    assert metrics(Residuals(4096), Straightforward(), dt=0.3)["td_loss"] <= 2 / 4096


@pytest.mark.parametrize("steps", [1, 3])
def test_look_ahead_stops_at_zero(steps):
    problem = Straight()
    seen = {}

    def critic(tau, x, action):
        seen.update(tau=tau, x=x)
        return x[None]

    solution = SimpleNamespace(actor=lambda tau, x: torch.zeros_like(x), critic=critic)
    tau = torch.tensor([[0.2], [0.5], [0.8], [2.0], [0.0]])
    replay = TensorDict({"tau": tau, "state": torch.full((5, 1), -50.0)}, [5])
    LookAhead(steps, Simulator(problem, 0.3, 2))(solution, replay, replay)  # type: ignore[arg-type]
    played = torch.minimum(tau, torch.full_like(tau, 0.3 * steps))
    torch.testing.assert_close(seen["x"] + 50, played, rtol=0, atol=1e-5)
    torch.testing.assert_close(seen["tau"], tau - played, rtol=0, atol=1e-6)
