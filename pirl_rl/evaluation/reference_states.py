"""States on which learned solutions are compared: near and far from where a reference policy goes.

The paper's protocol. States visited by noise-free episodes are moved in a random direction of network coordinates, in
which tau and x are scaled to [-1, 1]; the distance to the states visited says how far from the training data a critic
has to extrapolate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.monte_carlo import Policy
from pirl_rl.evaluation.trajectories import closed_loop
from pirl_rl.files import replacing
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates, moved
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator

GROUPS = ("closest", "near", "moderate", "far", "farthest")
CHUNK = 64
"""States whose distances to all visited ones are held at once."""


@dataclass(frozen=True)
class ReferenceStates:
    """N states outside A and B, tau > 0.

    Attributes:
        tau: (N,), s.
        x: (N, n), SI.
        distance: (N,), mean to the nearest visited states, network coordinates.
        group: (N,) int64, fifths by distance: index into `GROUPS`.
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
        """The protocol, from visited states.

        Args:
            problem: says which states are terminal.
            tau: visited times to go (M,).
            x: visited states (M, n).
            box: of (tau, x), n + 1 axes; its [-1, 1] coordinates are the network's.
            rng: of choice, direction and length.
            count: states before terminal ones are dropped.
            radius: largest displacement.
            neighbours: visited states in the mean distance, at most M.
        """
        if not 1 <= neighbours <= len(x):
            raise ArgumentError(f"neighbours: expected 1 to {len(x)}, the number of visited states, got {neighbours}")
        new_tau, new_x = displaced(problem, tau, x, box, rng, count, radius)
        visited, new = box.normalize(_joined(tau, x)), box.normalize(_joined(new_tau, new_x))
        distance = torch.cat([_mean_nearest(part, visited, neighbours) for part in new.split(CHUNK)])
        rank = distance.argsort().argsort()
        return cls(new_tau, new_x, distance, rank * len(GROUPS) // len(rank))

    def save(self, path: str | Path) -> None:
        """Write what `load` reads, in single precision."""
        arrays = {name: tensor.cpu().numpy() for name, tensor in vars(self).items()}
        small = {name: array.astype(np.int8 if name == "group" else np.float32) for name, array in arrays.items()}
        with replacing(Path(path), binary=True) as file:
            np.savez_compressed(file, **small)

    @classmethod
    def load(cls, path: str | Path) -> ReferenceStates:
        with np.load(path, allow_pickle=False) as file:
            tau, x, distance, group = (torch.from_numpy(file[name]) for name in ("tau", "x", "distance", "group"))
        return cls(tau, x, distance, group.long())


def displaced(
    problem: ReachAvoidProblem, tau: Tensor, x: Tensor, box: Box, rng: torch.Generator, count: int, radius: float
) -> tuple[Tensor, Tensor]:
    """Up to `count` of the states (M,), (M, n), each moved in a random direction of the box's coordinates by a length
    uniform in [0, radius] and clipped to the box; those in A or B or with tau = 0 are dropped."""
    if box.dim != x.shape[-1] + 1:
        raise ArgumentError(f"box: expected {x.shape[-1] + 1} axes, tau first, got {box.dim}")
    # Without repetition as long as there are enough.
    order = [torch.randperm(len(x), generator=rng, device=x.device) for _ in range(-(-count // len(x)))]
    chosen = torch.cat(order)[:count]
    z = moved(box.normalize(_joined(tau[chosen], x[chosen])), radius, rng).clamp(-1, 1)
    tau, x = (point := box.denormalize(z))[:, 0], point[:, 1:]
    kept = problem.interior(x) & (tau > 0)
    return tau[kept], x[kept]


def visited_by(
    simulator: Simulator, policy: Policy, starts: InitialStates, episodes: int, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """tau (M,) and states (M, n) on the paths of a policy, from each start to the state before the end."""
    max_steps = round(simulator.problem.horizon / simulator.dt)
    steps, x = starts.sample(simulator.problem, episodes, max_steps, rng, torch.get_default_dtype())
    paths = closed_loop(simulator, policy, (steps * simulator.dt).to(x), x, rng)
    index = torch.arange(len(paths.tau), device=x.device).unsqueeze(-1)
    return paths.tau[index < paths.steps], paths.state[index < paths.steps]


def _joined(tau: Tensor, x: Tensor) -> Tensor:
    return torch.cat([tau.unsqueeze(-1), x], -1)


def _mean_nearest(points: Tensor, others: Tensor, count: int) -> Tensor:
    """Mean distance (N,) of points (N, d) to the nearest `count` of others (M, d)."""
    # The default for many points subtracts squares, which loses small distances in single precision.
    distances = torch.cdist(points, others, compute_mode="donot_use_mm_for_euclid_dist")
    return distances.topk(count, largest=False).values.mean(-1)
