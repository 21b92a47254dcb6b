"""Reference states on which learned solutions are compared, near to and far from the paths of a reference policy.

This is the paper's protocol. States that episodes without exploration noise visit are moved in a random direction of
network coordinates, in which tau and x are scaled to [-1, 1]. The distance to the visited states tells how far from the
training data a critic has to extrapolate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pirl_rl.arguments import Policy
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.trajectories import closed_loop
from pirl_rl.files import replacing
from pirl_rl.layers import Periodic
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates, moved
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator

GROUPS = ("closest", "near", "moderate", "far", "farthest")
DISTANCE_ROWS = 64
"""Number of states whose distances to all visited states are in memory at once."""


@dataclass(frozen=True)
class ReferenceStates:
    """N states outside A and B, each with a time to go > 0.

    Attributes:
        tau: times to go (N,) in s.
        x: states (N, n) in SI units.
        distance: mean distances (N,) to the nearest visited states, in network coordinates.
        group: indices (N,) into `GROUPS`, int64; each group is a fifth of the states by distance.
    """

    tau: Tensor
    x: Tensor
    distance: Tensor
    group: Tensor

    @classmethod
    def from_visited(
        cls,
        problem: ReachAvoidProblem,
        tau: Tensor,
        x: Tensor,
        box: Box,
        rng: torch.Generator,
        count: int = 512,
        radius: float = 0.40,
        neighbours: int = 10,
    ) -> ReferenceStates:
        """Apply the protocol to visited states.

        Args:
            problem: defines which states are terminal.
            tau: visited times to go (M,) in s.
            x: visited states (M, n) in SI units.
            box: box of (tau, x) with n + 1 axes, periodic where that of the problem is; scaled to [-1, 1], and with
                sine and cosine of a periodic coordinate, it gives the network coordinates.
            rng: draws the choice of visited states, the directions and the lengths.
            count: number of states before terminal ones are dropped.
            radius: largest displacement in network coordinates.
            neighbours: number of visited states in the mean distance, at most M.

        Raises:
            ArgumentError: if `neighbours` or the number of axes of `box` does not fit.
        """
        if not 1 <= neighbours <= len(x):
            raise ArgumentError(f"neighbours: expected 1 to {len(x)}, the number of visited states, got {neighbours}")
        new_tau, new_x = displaced(problem, tau, x, box, rng, count, radius)
        visited, new = _coordinates(box, tau, x), _coordinates(box, new_tau, new_x)
        distance = torch.cat([_mean_nearest(part, visited, neighbours) for part in new.split(DISTANCE_ROWS)])
        rank = distance.argsort().argsort()
        return cls(new_tau, new_x, distance, rank * len(GROUPS) // len(rank))

    def save(self, path: str | Path) -> None:
        """Write the states to a file for `load`, in single precision."""
        arrays = {name: tensor.cpu().numpy() for name, tensor in vars(self).items()}
        small = {name: array.astype(np.int8 if name == "group" else np.float32) for name, array in arrays.items()}
        with replacing(Path(path), binary=True) as file:
            np.savez_compressed(file, **small)

    @classmethod
    def load(cls, path: str | Path) -> ReferenceStates:
        """Read the states from a file that `save` wrote."""
        with np.load(path, allow_pickle=False) as file:
            tau, x, distance, group = (torch.from_numpy(file[name]) for name in ("tau", "x", "distance", "group"))
        return cls(tau, x, distance, group.long())


def displaced(
    problem: ReachAvoidProblem, tau: Tensor, x: Tensor, box: Box, rng: torch.Generator, count: int, radius: float
) -> tuple[Tensor, Tensor]:
    """Move states in random directions of the box's coordinates by lengths uniform in [0, radius], clipped to the box.

    Args:
        problem: defines which states are terminal.
        tau: times to go (M,) in s.
        x: states (M, n) in SI units.
        box: box of (tau, x) with n + 1 axes, periodic where that of the problem is.
        rng: draws the choice of states, the directions and the lengths.
        count: number of states that are moved.
        radius: largest displacement in the coordinates in which the box is [-1, 1]^(n + 1).

    Returns:
        tau (N,) and x (N, n), N <= count: states in A or B or with tau = 0 are dropped.

    Raises:
        ArgumentError: if the box has another number of axes.
    """
    if box.dim != x.shape[-1] + 1:
        raise ArgumentError(f"box: expected {x.shape[-1] + 1} axes, tau first, got {box.dim}")
    # Each state is chosen once before any is chosen again.
    order = [torch.randperm(len(x), generator=rng, device=x.device) for _ in range(-(-count // len(x)))]
    chosen = torch.cat(order)[:count]
    z, circles = moved(box.normalize(_joined(tau[chosen], x[chosen])), radius, rng), list(box.periodic)
    clipped = z.clamp(-1, 1)
    clipped[:, circles] = z[:, circles]
    tau, x = (point := box.wrap(box.denormalize(clipped)))[:, 0], point[:, 1:]
    kept = problem.interior(x) & (tau > 0)
    return tau[kept], x[kept]


def visited_by(
    simulator: Simulator, policy: Policy, starts: InitialStates, episodes: int, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """tau (M,) in s and states (M, n) on the paths of a policy, from each start to the last state before the end."""
    clock = simulator.clock
    steps, x = starts.sample(simulator.problem, episodes, clock.max_steps, rng, torch.get_default_dtype())
    paths = closed_loop(simulator, policy, clock.time(steps).to(x), x, rng)
    index = torch.arange(len(paths.tau), device=x.device).unsqueeze(-1)
    return paths.tau[index < paths.steps], paths.state[index < paths.steps]


def _coordinates(box: Box, tau: Tensor, x: Tensor) -> Tensor:
    """The network coordinates (N, d) of tau (N,) and x (N, n)."""
    z = box.normalize(_joined(tau, x))
    return Periodic(box.dim, box.periodic).to(z)(z) if box.periodic else z


def _joined(tau: Tensor, x: Tensor) -> Tensor:
    return torch.cat([tau.unsqueeze(-1), x], -1)


def _mean_nearest(points: Tensor, others: Tensor, count: int) -> Tensor:
    """Mean distances (N,) of points (N, d) to the `count` nearest of the others (M, d)."""
    # For many points torch's default mode subtracts squares, which loses small distances in single precision.
    distances = torch.cdist(points, others, compute_mode="donot_use_mm_for_euclid_dist")
    return distances.topk(count, largest=False).values.mean(-1)
