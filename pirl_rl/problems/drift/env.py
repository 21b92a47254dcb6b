"""Vehicle drifting as a TorchRL environment."""

from __future__ import annotations

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.problems.drift.problem import VehicleDrift


class DriftEnv(ReachAvoidEnv):
    """The drifting vehicle of Sec. V-B of the paper. It takes the arguments of `ReachAvoidEnv` except `problem`.

    By default exits are detected at the ends of sub-steps, since Brownian bridges for the 17 faces of the sets cost
    more than shorter sub-steps.
    """

    def __init__(self, crossing: str = "endpoint", **kwargs):
        super().__init__(VehicleDrift(), crossing=crossing, **kwargs)
