"""One-dimensional reachability as a TorchRL environment."""

from __future__ import annotations

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.problems.reach1d import Reach1D


class Reach1DEnv(ReachAvoidEnv):
    """The paper's one-dimensional benchmark, Sec. V-A; the arguments are those of `ReachAvoidEnv` but the problem."""

    def __init__(self, **kwargs):
        super().__init__(Reach1D(), **kwargs)
