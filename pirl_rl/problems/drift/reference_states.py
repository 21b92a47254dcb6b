"""The states at which values for the drifting vehicle are compared, and how they are made."""

from __future__ import annotations

from pathlib import Path

import torch

from pirl_rl.arguments import Policy
from pirl_rl.evaluation.reference_states import ReferenceStates, visited_by
from pirl_rl.problems import VehicleDrift
from pirl_rl.problems.drift.starts import EquilibriumStates
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator

FILE = Path(__file__).with_name("reference_states.npz")
NETWORK_BOX = Box([0, -2, -0.8, 3, -12, -2.5, -0.7, 0.25], [5, 2, 0.8, 25, 12, 2.5, 0.7, 1.05])
"""The box of (tau, x) that the networks of the paper scale to [-1, 1]^8, wider than `VehicleDrift.states`."""
EPISODES = 1_024
"""The number of episodes whose states are visited."""


def drift_states(policy: Policy, seed: int = 0) -> ReferenceStates:
    """Make reference states as the paper does, from the states that a policy visits.

    The policy plays 1,024 episodes without exploration noise. They start from `EquilibriumStates` in the whole boxes,
    with a random number of steps to go, and are simulated as in the paper: Euler-Maruyama steps of 0.1 s, and exits at
    their ends.

    Args:
        policy: maps tau (N,), in s, and x (N, 7) to controls (N, 2), in SI units.
        seed: the seed of the episodes and of the choice of states.
    """
    problem, rng = VehicleDrift(), torch.Generator().manual_seed(seed)
    simulator = Simulator(problem, dt=0.1, substeps=1, crossing="endpoint")
    tau, x = visited_by(simulator, policy, EquilibriumStates(), EPISODES, rng)
    return ReferenceStates.from_visited(problem, tau, x, NETWORK_BOX, rng)


class DriftStates:
    """Gives the reference states.

    Args:
        run: directory of a run whose policy visits the states; by default the states are those in the package, which
            the TD3 policy of the paper with random horizon visited.
    """

    def __init__(self, run: str | None = None):
        self.run = run

    def __call__(self) -> ReferenceStates:
        """Read or make the reference states.

        Raises:
            ConfigError: `run` is not a run directory, or its problem is another one.
        """
        if self.run is None:
            return ReferenceStates.load(FILE)
        # Imported here, because opening a run builds its evaluators, which may use this class.
        from pirl_rl.errors import ConfigError
        from pirl_rl.runs.load import load_run

        reference = load_run(self.run)
        if type(reference.problem) is not VehicleDrift:
            raise ConfigError(f"evaluation.reference: expected a run of VehicleDrift, got {self.run}")
        return drift_states(reference.solution.policy)
