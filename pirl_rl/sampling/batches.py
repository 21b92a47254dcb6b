"""The batch of one update: transitions, collocation points and boundary points."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from pirl_rl.sampling.boundary import BoundarySampler
from pirl_rl.sampling.collocation import Collocation
from pirl_rl.schedules import Weights

NEGLIGIBLE = 1e-6
"""A weight below this share of its largest over the run counts as zero, as a sigmoid's far from its center."""


class BatchSampler:
    """Draws batches for `PIRLLoss`; a term of negligible weight costs no work.

    Args:
        buffer: holds the transitions.
        collocation: sampler of the interior points; a stage of training may replace it.
        boundary: sampler of the boundary points.
        size: transitions of a batch.
        largest: the largest weight of each term over the run.
        device: of the batch.
        seed: of the points.
    """

    def __init__(
        self,
        buffer: TensorDictReplayBuffer,
        collocation: Collocation,
        boundary: BoundarySampler,
        size: int,
        largest: Weights,
        device: torch.device,
        seed: int,
    ):
        self.buffer, self.collocation, self.boundary = buffer, collocation, boundary
        self.size, self.largest, self.device = size, largest, device
        self.rng = torch.Generator(device).manual_seed(seed)

    def parts(self, weights: Weights) -> tuple[bool, ...]:
        """Whether the TD, the HJB and the boundary term count with the weights (w_TD, w_HJB, w_BC)."""
        return tuple(w > NEGLIGIBLE * most for w, most in zip(weights, self.largest, strict=True))

    def sample(self, weights: Weights, progress: float | Tensor) -> TensorDict:
        """{"replay", "collocation", "boundary"}; without the TD term, "replay" has no "next".

        Args:
            weights: (w_TD, w_HJB, w_BC) of the update.
            progress: how far the schedule of the weights has come, in [0, 1]; a scalar.
        """
        td, hjb, boundary = self.parts(weights)
        replay = self.buffer.sample(self.size)
        parts = {"replay": replay if td else replay.exclude("next")}
        if hjb:
            parts["collocation"] = self.collocation.sample(self.rng, replay, progress)
        if boundary:
            parts["boundary"] = self.boundary.sample(self.rng, replay)
        return TensorDict(parts, device=self.device)
