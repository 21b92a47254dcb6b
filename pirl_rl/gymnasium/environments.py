"""Any problem as a Gymnasium environment, single or vectorised, for learners that are made for those.

An observation is the time to go and the state, scaled so that the horizon and the box of states are [-1, 1]; a periodic
coordinate is given by its sine and cosine. An action is the control, scaled so that the box of controls is [-1, 1]^m.
The reward is the payoff at the end of an episode and 0 before, so that the return without discount is success. Every
end is a termination, since the time to go is observed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

try:
    import gymnasium
except ModuleNotFoundError as error:
    hint = "pirl_rl.gymnasium needs gymnasium: pip install 'pirl_rl[baselines]'"
    raise ModuleNotFoundError(hint, name="gymnasium") from error
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.layers import Periodic
from pirl_rl.problem import ReachAvoidProblem

Array = NDArray[np.float32]


def observation(problem: ReachAvoidProblem, tau: Tensor, x: Tensor) -> Tensor:
    """The observation (*, 1 + n + p) at times to go (*), in s, and states (*, n), with p periodic coordinates."""
    time = 2 * tau.unsqueeze(-1) / problem.horizon - 1
    state = Periodic(problem.states.dim, problem.states.periodic)(problem.states.normalize(x))
    return torch.cat([time, state], -1)


class ReachAvoidVectorGym(VectorEnv):
    """A `ReachAvoidEnv` as a vector environment; an episode that ends is followed by the next in the same step.

    Args:
        env: the environment, whose number of paths is the number of environments here.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env: ReachAvoidEnv):
        self.env, self.num_envs = env, env.batch_size[0]
        width = observation(env.problem, torch.zeros(1), torch.zeros(1, env.problem.states.dim)).shape[-1]
        self.single_observation_space = Box(-np.inf, np.inf, (width,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (env.problem.controls.dim,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._state: TensorDictBase = TensorDict(batch_size=env.batch_size)

    @property
    def time_and_state(self) -> tuple[Tensor, Tensor]:
        """The times to go (N,), in s, and the states (N, n) of the paths, in SI units."""
        return self._state["tau"].squeeze(-1), self._state["state"]

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start all episodes anew; a seed that is one number fixes them and all that follow, others are not used."""
        super().reset(seed=seed if isinstance(seed, int) else None)
        if isinstance(seed, int):
            self.env.set_seed(seed)
        self._state = self.env.reset()
        return self._observed(self._state), {}

    def step(self, actions: Array) -> tuple[Array, NDArray, NDArray, NDArray, dict[str, Any]]:
        """Advance all paths; `final_obs` in the information has the observations with which episodes ended."""
        action = torch.as_tensor(np.clip(actions, -1.0, 1.0), dtype=torch.get_default_dtype(), device=self.env.device)
        done, self._state = self.env.step_and_maybe_reset(self._state.set("action", action))
        ended = done["next", "done"].squeeze(-1).cpu().numpy()
        reward = done["next", "reward"].squeeze(-1).cpu().numpy().astype(np.float64)
        infos = {"final_obs": self._observed(done["next"]), "_final_obs": ended} if ended.any() else {}
        return self._observed(self._state), reward, ended, np.zeros_like(ended), infos

    def _observed(self, state: TensorDictBase) -> Array:
        return observation(self.env.problem, state["tau"].squeeze(-1), state["state"]).cpu().numpy().astype(np.float32)


class ReachAvoidGym(gymnasium.Env[Array, Array]):
    """One path of a problem as an environment.

    Args:
        problem: the physics.
        settings: other arguments of `ReachAvoidEnv`, such as `dt`.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, problem: ReachAvoidProblem, **settings: Any):
        self.paths = ReachAvoidVectorGym(ReachAvoidEnv(problem, num_envs=1, **settings))
        self.observation_space = self.paths.single_observation_space
        self.action_space = self.paths.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode; a seed fixes it and all that follow."""
        super().reset(seed=seed)
        return self.paths.reset(seed=seed)[0][0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Advance the path by one control step: observation, reward, end, False, no information."""
        after, reward, ended, _, infos = self.paths.step(np.asarray(action)[None])
        last = infos["final_obs"] if ended[0] else after
        return last[0], float(reward[0]), bool(ended[0]), False, {}
