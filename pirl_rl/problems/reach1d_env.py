"""One-dimensional reachability as a TorchRL environment."""

from __future__ import annotations

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.problems.reach1d import Reach1D


class Reach1DEnv(ReachAvoidEnv):
    """The benchmark of Sec. V-A of the paper. It takes the arguments of `ReachAvoidEnv` except `problem`."""

    def __init__(self, **kwargs):
        super().__init__(Reach1D(), **kwargs)
