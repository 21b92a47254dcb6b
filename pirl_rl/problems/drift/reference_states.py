"""The reference states of the drifting problem, and the recipe behind them."""

from __future__ import annotations

from pathlib import Path

import torch

from pirl_rl.evaluation.monte_carlo import Policy
from pirl_rl.evaluation.reference_states import ReferenceStates, visited_by
from pirl_rl.problems import VehicleDrift
from pirl_rl.problems.drift.starts import EquilibriumStates
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator

FILE = Path(__file__).with_name("reference_states.npz")
NETWORK_BOX = Box([0, -2, -0.8, 3, -12, -2.5, -0.7, 0.25], [5, 2, 0.8, 25, 12, 2.5, 0.7, 1.05])
"""Of (tau, x): the [-1, 1] coordinates of the paper's networks, wider than `VehicleDrift.states`."""
EPISODES = 1_024


def drift_states(policy: Policy, seed: int = 0) -> ReferenceStates:
    """The paper's recipe for any policy: 1,024 noise-free episodes from the paper's full-scale training starts, steps
    to go random, the paper's simulator (Euler steps of 0.1 s, exits at end points)."""
    problem, rng = VehicleDrift(), torch.Generator().manual_seed(seed)
    simulator = Simulator(problem, dt=0.1, substeps=1, crossing="endpoint")
    tau, x = visited_by(simulator, policy, EquilibriumStates(), EPISODES, rng)
    return ReferenceStates.from_visited(problem, tau, x, NETWORK_BOX, rng)


class DriftStates:
    """Gives the reference states.

    Args:
        run: directory of a run whose policy visits them; default the committed set, visited by the paper's TD3 policy
            of random horizon.
    """

    def __init__(self, run: str | None = None):
        self.run = run

    def __call__(self) -> ReferenceStates:
        """
        Raises:
            ConfigError: not a run directory, or one of another problem.
        """
        if self.run is None:
            return ReferenceStates.load(FILE)
        # Runs build evaluators, this one among them.
        from pirl_rl.configuration import ConfigError
        from pirl_rl.runs.load import load_run

        reference = load_run(self.run)
        if type(reference.problem) is not VehicleDrift:
            raise ConfigError(f"evaluation.reference: expected a run of VehicleDrift, got {self.run}")
        return drift_states(reference.solution.policy)
