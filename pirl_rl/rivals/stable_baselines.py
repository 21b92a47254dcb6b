"""PPO and SAC of Stable-Baselines3 on the Gymnasium view of a problem, trained for a given time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from pirl_rl.arguments import Policy
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.gymnasium import ReachAvoidVectorGym, observation
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator

FOREVER = 10**12
"""A number of steps that no training reaches, since time ends it."""


def ppo(problem: ReachAvoidProblem, simulator: Simulator, seconds: float, seed: int) -> Policy:
    """Proximal policy optimisation; batches of 64 paths times 256 steps, no discount, otherwise the library's defaults.

    Args:
        problem: the physics.
        simulator: gives control step, sub-steps and the rule of exits.
        seconds: the time of training, in s.
        seed: of networks, starts and noise.
    """

    def make(paths: VecEnv) -> PPO:
        return PPO("MlpPolicy", paths, n_steps=256, batch_size=1_024, gamma=1.0, seed=seed, device="cpu")

    return _trained(make, problem, simulator, 64, seconds, seed)


def sac(problem: ReachAvoidProblem, simulator: Simulator, seconds: float, seed: int) -> Policy:
    """Soft actor-critic; 16 paths, one update for each step of them all, otherwise the library's defaults.

    The weight of the entropy starts at 0.01, since the whole reward is at most 1. The discount is that of the library
    for an episode of 100 steps, 0.99^(100/K) for K control steps in the horizon.

    Args:
        problem: the physics.
        simulator: gives control step, sub-steps and the rule of exits.
        seconds: the time of training, in s.
        seed: of networks, starts and noise.
    """
    discount = 0.99 ** (100 / simulator.clock.max_steps)

    def make(paths: VecEnv) -> SAC:
        return SAC("MlpPolicy", paths, gamma=discount, ent_coef="auto_0.01", seed=seed, device="cpu")

    return _trained(make, problem, simulator, 16, seconds, seed)


def _trained(
    make: Callable[[VecEnv], BaseAlgorithm],
    problem: ReachAvoidProblem,
    simulator: Simulator,
    paths: int,
    seconds: float,
    seed: int,
) -> Policy:
    settings = {"dt": simulator.dt, "substeps": simulator.substeps, "crossing": simulator.crossing}
    env = ReachAvoidEnv(problem, **settings, num_envs=paths, seed=seed, compile_simulator=True)
    model = make(Paths(ReachAvoidVectorGym(env)))
    model.learn(FOREVER, callback=Stopwatch(seconds))

    @torch.no_grad()
    def policy(tau: Tensor, x: Tensor) -> Tensor:
        action, _ = model.predict(observation(problem, tau, x).float().numpy(), deterministic=True)
        return problem.controls.denormalize(torch.as_tensor(action).to(x))

    return policy


class Stopwatch(BaseCallback):
    """Ends a training after a time.

    Args:
        seconds: the time, in s.
    """

    def __init__(self, seconds: float):
        super().__init__()
        self.seconds = seconds

    def _on_training_start(self) -> None:
        self._started = time.perf_counter()

    def _on_step(self) -> bool:
        return time.perf_counter() - self._started < self.seconds


class Paths(VecEnv):
    """A vector environment of Gymnasium for Stable-Baselines3, which has an interface of its own.

    Args:
        paths: the vector environment.
    """

    def __init__(self, paths: ReachAvoidVectorGym):
        self.paths = paths  # before the parent class, which asks the paths for an attribute
        super().__init__(paths.num_envs, paths.single_observation_space, paths.single_action_space)

    def reset(self) -> np.ndarray:
        return self.paths.reset()[0]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        after, reward, done, _, found = self.paths.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in done]
        for index in done.nonzero()[0]:
            infos[index] = {"terminal_observation": found["final_obs"][index], "TimeLimit.truncated": False}
        return after, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """There is nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.paths, attr_name, None)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.paths, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError(f"{method_name}: the paths of one batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(self._indices(indices))

    def _indices(self, indices: Any) -> Sequence[int]:
        return range(self.num_envs) if indices is None else np.atleast_1d(indices).tolist()
