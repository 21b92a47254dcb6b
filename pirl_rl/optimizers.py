"""The optimisers of a network: Adam, or Muon for the weights between hidden layers and Adam for the rest."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictParams
from torch import Tensor, nn

RATE = 4.0
"""The length of a step of Muon along each singular direction, as a multiple of Adam's learning rate."""

MOMENTUM = 0.95

COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""The polynomial of Jordan et al. (2024), whose iterates bring all but the smallest singular values to 0.7 to 1.2."""

ITERATIONS = 5


def optimizers(params: TensorDictParams, rate: float, kind: Literal["adam", "muon"]) -> list[torch.optim.Optimizer]:
    """The optimisers of a network, or of several whose parameters are stacked along a leading axis.

    Args:
        params: the parameters of an `Actor` or of a `Critic`.
        rate: the learning rate.
        kind: "adam" takes Adam for all parameters. "muon" takes Muon for the weights between hidden layers, and Adam
            for the biases and for the weights of the first and the last layer.
    """
    named = dict(params.named_parameters())
    weights = sorted((name for name in named if name.endswith("weight")), key=lambda name: int(name.split(".")[-2]))
    hidden = weights[1:-1] if kind == "muon" else []
    adam = torch.optim.Adam([parameter for name, parameter in named.items() if name not in hidden], rate, fused=True)
    return [adam, Muon([named[name] for name in hidden], rate)] if hidden else [adam]


class Muon(torch.optim.Optimizer):
    """Steps along Nesterov's momentum, whose singular values are made nearly equal before (Jordan et al., 2024).

    The small directions of a gradient then count as much as the large ones, and thin layers of V take fewer updates to
    learn than with Adam (https://kellerjordan.github.io/posts/muon). `torch.optim.Muon` takes matrices one by one, and
    in bfloat16, which many CPUs emulate. This class takes matrices that are stacked along leading axes, in their own
    precision.

    Args:
        weights: parameters (*, out, in).
        lr: the learning rate of Adam that would suit the same network; steps are `RATE` times as long.
    """

    def __init__(self, weights: list[nn.Parameter], lr: float):
        super().__init__(weights, {"lr": lr})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        for group in self.param_groups:
            # Matrices of one shape are made orthogonal together, which costs less than one after another.
            for shape in dict.fromkeys(weight.shape for weight in group["params"]):
                weights = [weight for weight in group["params"] if weight.shape == shape]
                out, into = shape[-2:]
                length = RATE * group["lr"] * max(1.0, out / into) ** 0.5
                directions = orthogonal(torch.stack([self._direction(weight, weight.grad) for weight in weights]))
                for weight, direction in zip(weights, directions, strict=True):
                    weight.sub_(direction, alpha=length)

    def _direction(self, weight: Tensor, gradient: Tensor) -> Tensor:
        """Nesterov's momentum of a weight, after a gradient has been added to it."""
        momentum = self.state[weight].setdefault("momentum", torch.zeros_like(weight))
        momentum.lerp_(gradient, 1 - MOMENTUM)
        return gradient.lerp(momentum, MOMENTUM)


def orthogonal(matrix: Tensor) -> Tensor:
    """Nearly the orthogonal factor U V^T of the matrices (*, out, in) = U S V^T, by Newton-Schulz iterations."""
    a, b, c = COEFFICIENTS
    x = matrix / matrix.norm(dim=(-2, -1), keepdim=True).clamp(min=1e-7)
    x = x.reshape(-1, *x.shape[-2:])
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        # a x + (b gram + c gram^2) x
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.reshape(matrix.shape)
