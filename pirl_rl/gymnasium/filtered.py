"""Environments of Gymnasium in which a learned solution protects the actions of the learner."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorActionWrapper, VectorEnv, VectorWrapper
from numpy.typing import NDArray

from pirl_rl.errors import ArgumentError
from pirl_rl.filters import ReachAvoidFilter
from pirl_rl.gymnasium.environments import Array, ReachAvoidGym, ReachAvoidVectorGym


class FilteredGym(gymnasium.Wrapper):
    """One path whose actions a filter corrects.

    The information of a step has `intervened`, whether the filter took another action, and `action`, the one (m,) that
    it took, normalised to [-1, 1].

    Args:
        env: an environment of this package, possibly inside other wrappers, but none that changes actions: such a
            wrapper goes around this one, as in `RescaleAction(FilteredGym(env, reach_avoid_filter), 0.0, 1.0)`.
        reach_avoid_filter: the filter; its own nominal controller has no part, since the action is the nominal control.

    Raises:
        ArgumentError: the environment is not one of this package, a wrapper inside changes actions, or the filter is
            that of another problem.
    """

    def __init__(self, env: gymnasium.Env, reach_avoid_filter: ReachAvoidFilter):
        super().__init__(env)
        if not isinstance(env.unwrapped, ReachAvoidGym):
            raise ArgumentError(f"env: expected a ReachAvoidGym, got a {type(env.unwrapped).__name__}")
        _expect_no_change_of_actions(env)
        self._paths, self._filter = env.unwrapped.paths, reach_avoid_filter
        _expect_same_problem(self._paths, reach_avoid_filter)

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Play the corrected action in place of the given one (m,)."""
        corrected, intervened = _corrected(self._paths, self._filter, np.asarray(action)[None])
        seen, reward, terminated, truncated, info = self.env.step(corrected[0])
        return seen, reward, terminated, truncated, {**info, "intervened": bool(intervened[0]), "action": corrected[0]}


class FilteredVectorGym(VectorWrapper):
    """Many paths whose actions a filter corrects; the information of a step has `intervened` (N,) and `action` (N, m).

    Args:
        env: a vector environment of this package, possibly inside other wrappers, see `FilteredGym`.
        reach_avoid_filter: see `FilteredGym`.

    Raises:
        ArgumentError: see `FilteredGym`.
    """

    def __init__(self, env: VectorEnv, reach_avoid_filter: ReachAvoidFilter):
        super().__init__(env)
        if not isinstance(env.unwrapped, ReachAvoidVectorGym):
            raise ArgumentError(f"env: expected a ReachAvoidVectorGym, got a {type(env.unwrapped).__name__}")
        _expect_no_change_of_actions(env)
        self._paths, self._filter = env.unwrapped, reach_avoid_filter
        _expect_same_problem(self._paths, reach_avoid_filter)

    def step(self, actions: Array) -> tuple[Array, NDArray, NDArray, NDArray, dict[str, Any]]:
        """Play the corrected actions in place of the given ones (N, m)."""
        corrected, intervened = _corrected(self._paths, self._filter, np.asarray(actions))
        seen, reward, ended, cut, infos = self.env.step(corrected)
        # The library marks by a name with an underscore which paths an entry belongs to.
        every = np.ones(len(intervened), dtype=bool)
        found = {"intervened": intervened, "_intervened": every, "action": corrected, "_action": every}
        return seen, reward, ended, cut, {**infos, **found}


def _corrected(
    paths: ReachAvoidVectorGym, reach_avoid_filter: ReachAvoidFilter, actions: Array
) -> tuple[Array, NDArray]:
    """The actions (N, m) that the filter takes in place of the given ones, and where it intervened (N,)."""
    controls, (tau, x) = paths.env.problem.controls, paths.time_and_state
    action = torch.as_tensor(np.clip(actions, -1.0, 1.0), dtype=x.dtype)
    u, intervened = reach_avoid_filter.correct(tau, x, controls.denormalize(action))
    played = torch.where(intervened.unsqueeze(-1), controls.normalize(u), action).clamp(-1, 1)
    return played.numpy().astype(np.float32), intervened.numpy()


def _expect_no_change_of_actions(env: gymnasium.Env | VectorEnv) -> None:
    """Refuse wrappers of actions: the filter gives the normalised control, which they would change once more."""
    while isinstance(env, (gymnasium.Wrapper, VectorWrapper)):
        changes = isinstance(env, (gymnasium.ActionWrapper, VectorActionWrapper))
        if changes or env.action_space != env.env.action_space:
            name = type(env).__name__
            raise ArgumentError(
                f"env: expected no wrapper inside the filter that changes actions, got {name}; put it around the "
                f"filtered environment, as in {name}(FilteredGym(env, reach_avoid_filter), ...)"
            )
        env = env.env


def _expect_same_problem(paths: ReachAvoidVectorGym, reach_avoid_filter: ReachAvoidFilter) -> None:
    ours, theirs = type(paths.env.problem), type(reach_avoid_filter.problem)
    if ours is not theirs:
        raise ArgumentError(f"reach_avoid_filter: expected one of the problem {ours.__name__}, got {theirs.__name__}")
