"""Control variate: returns without the noise of the physics have the same mean and a smaller variance."""

from __future__ import annotations

import pytest
import torch
from small import assert_same, at_update, interrupt, resumed, small_trainer
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor

from pirl_rl.collectors import ControlVariate
from pirl_rl.collectors.transitions import Exploration, PlayedPolicy, Transitions
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.errors import ArgumentError, Interrupted
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.problems import Reach1D
from pirl_rl.sampling.initial_states import UniformStates
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

CONTROL_VARIATE = "+collector.control_variate={_target_: pirl_rl.collectors.ControlVariate}"
STEPS, PATHS = 50, 8_000
START = (1.0, 0.8)  # the time to go and the state in which all paths start


class StartAt(UniformStates):
    """All episodes start in one state with one time to go."""

    def sample(self, problem, count, max_steps, rng, dtype, visited=None):
        return torch.full((count,), STEPS), torch.full((count, 1), START[1], dtype=dtype)


def exact_slope(problem: Reach1D):
    def slope(tau: Tensor, x: Tensor) -> Tensor:
        value = lambda y: problem.exact_value(tau.squeeze(-1), y).sum()  # noqa: E731
        return torch.func.grad(value)(x)

    return slope


def returns(slope, seed: int = 0) -> Tensor:
    """Returns (PATHS,) of whole episodes from `START` under the optimal control, with a slope of V if there is one."""
    problem = Reach1D()
    env = ReachAvoidEnv(problem, START[0] / STEPS, initial_states=StartAt(), num_envs=PATHS, seed=seed)
    modules = [TensorDictModule(lambda x: torch.ones_like(x), in_keys=["state"], out_keys=["action"])]
    if slope is not None:
        modules.append(TensorDictModule(slope, in_keys=["tau", "state"], out_keys=["slope"]))
    batch = env.rollout(STEPS, TensorDictSequential(*modules), break_when_any_done=False)
    first = Transitions(STEPS)(batch).reshape(PATHS, STEPS)[:, 0]
    assert first["next", "terminated"].all()
    return first["next", "reward"].squeeze(-1)


def test_the_exact_slope_takes_the_noise_out_and_a_wrong_one_keeps_the_mean():
    exact = Reach1D().exact_value(torch.tensor([START[0]]), torch.tensor([[START[1]]])).item()
    plain, calm, wrong = returns(None), returns(exact_slope(Reach1D())), returns(lambda tau, x: 3 * torch.cos(5 * x))
    for sample in (plain, calm, wrong):
        # Four standard errors; the bridge leaves no bias for constant coefficients.
        assert abs(sample.mean().item() - exact) < 4 * sample.std().item() / PATHS**0.5
    # The variance that is left is that of the step's length: it falls as 1/STEPS.
    assert calm.var() < 0.1 * plain.var()


def test_the_sum_stops_with_the_episode_and_the_batch():
    place = torch.arange(5.0).view(1, 5, 1)
    ended = place == 2
    batch = TensorDict(
        {
            **{"tau": place, "state": place.expand(1, 5, 2), "action": place, "loc": place},
            "slope": torch.stack([place, 2 * place], -1).view(1, 5, 2),
            "next": {
                **{"tau": place, "state": place.expand(1, 5, 2), "reward": torch.zeros_like(place)},
                **{"noise": torch.ones(1, 5, 2), "terminated": ended, "done": ended},
            },
        },
        batch_size=[1, 5],
    )
    # Step k contributes k + 2 k. Returns of two steps from 0 sum the steps 0 and 1; that from 2 ends with its episode.
    gains = 3 * torch.tensor([0 + 1, 1 + 2, 2, 3 + 4, 4.0])
    assert torch.allclose(Transitions(2)(batch)["next", "reward"].squeeze(-1), -gains)


def test_the_policy_notes_the_slope_of_the_mean_of_the_critics():
    problem = Reach1D()
    torch.manual_seed(0)
    solution = Solution(problem, Actor(problem), stack([Critic(problem, output="Sigmoid") for _ in range(2)]))
    tau, x = torch.rand(7, 1), torch.randn(7, 1)
    slope, v = solution.gradient(tau.squeeze(-1), x), solution.raw_value(tau.squeeze(-1), x).unsqueeze(-1)
    # sigma is 1 and dt 0.04: the deviation of V in a step is a fifth of its slope.
    for limit in (10.0, 0.2 * slope.abs().median().item()):
        variate = ControlVariate(solution, Simulator(problem, 0.04), compile=False, limit=limit)
        policy = PlayedPolicy(solution.actor, Exploration(0.0, "always"), variate)
        played = policy(TensorDict({"tau": tau, "state": x, "is_init": torch.ones(7, 1, dtype=torch.bool)}, [7]))
        largest = (2 * limit * (v * (1 - v)).clamp(min=0).sqrt() / 0.2).clamp(min=5e-6)
        shortened = torch.minimum(torch.maximum(slope, -largest), largest)
        assert torch.allclose(played["slope"], shortened, atol=1e-6)
    assert 0 < (shortened != slope).sum() < 7


def test_training_follows_the_critics_and_resumes_bit_for_bit(tmp_path):
    whole = small_trainer(tmp_path / "whole", CONTROL_VARIATE, "trainer.updates=8")
    whole.train()
    # Rewards of episodes are 0 or 1; with the control variate, those in the buffer are not.
    reward = whole.collector.buffer[:]["next", "reward"]
    assert ((reward != 0) & (reward != 1)).float().mean() > 0.5
    part = small_trainer(tmp_path / "part", CONTROL_VARIATE, "trainer.updates=8")
    at_update(part, 5, interrupt)
    with pytest.raises(Interrupted):
        part.train()
    rest = resumed(tmp_path / "part", CONTROL_VARIATE, "trainer.updates=8")
    rest.train()
    assert_same(whole.learner.loss.state_dict(), rest.learner.loss.state_dict())


@pytest.mark.slow
def test_workers_take_the_noise_out_too(tmp_path):
    trainer = small_trainer(
        tmp_path,
        *("collector=multi_async", "collector.warmup_frames=128", "collector.updates_per_batch=2"),
        *("collector.workers=1", "trainer.updates=30", CONTROL_VARIATE),
    )
    trainer.train()
    reward = trainer.collector.buffer[:]["next", "reward"]
    assert ((reward != 0) & (reward != 1)).any()


def test_a_control_variate_needs_a_solution():
    with pytest.raises(TypeError):
        ControlVariate()  # type: ignore[call-arg]


def test_a_limit_is_positive():
    problem = Reach1D()
    solution = Solution(problem, Actor(problem), stack([Critic(problem)]))
    with pytest.raises(ArgumentError, match=r"control_variate\.limit: expected a number > 0, got 0"):
        ControlVariate(solution, Simulator(problem), compile=False, limit=0)
