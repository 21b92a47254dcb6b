"""Vehicle drifting as a TorchRL environment."""

from __future__ import annotations

from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.problems.drift.problem import VehicleDrift


class DriftEnv(ReachAvoidEnv):
    """The paper's vehicle drifting, Sec. V-B. Exits are watched at the ends of sub-steps, since a Brownian bridge over
    the 17 faces of its sets costs more than shorter steps do. The other arguments are those of `ReachAvoidEnv`.
    """

    def __init__(self, crossing: str = "endpoint", **kwargs):
        super().__init__(VehicleDrift(), crossing=crossing, **kwargs)
