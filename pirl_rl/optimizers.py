"""The optimisers of a network: Adam, or Muon for the weights between hidden layers and Adam for the rest."""

from __future__ import annotations

from collections.abc import Sequence
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


def optimizers(
    params: TensorDictParams, rate: float | Tensor, kind: Literal["adam", "muon"]
) -> list[torch.optim.Optimizer]:
    """The optimisers of a network, or of several whose parameters are stacked along a leading axis.

    Args:
        params: the parameters of an `Actor` or of a `Critic`.
        rate: the learning rate. A tensor on a GPU can be changed in place, also where steps are recorded as a graph.
        kind: "adam" takes Adam for all parameters. "muon" takes Muon for the weights between hidden layers, and Adam
            for the biases and for the weights of the first and the last layer.
    """
    named = dict(params.named_parameters())
    weights = sorted((name for name in named if name.endswith("weight")), key=lambda name: int(name.split(".")[-2]))
    hidden = weights[1:-1] if kind == "muon" else []
    others = [parameter for name, parameter in named.items() if name not in hidden]
    adam = torch.optim.Adam(others, rate, fused=True, capturable=isinstance(rate, Tensor))
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

    def __init__(self, weights: list[nn.Parameter], lr: float | Tensor):
        super().__init__(weights, {"lr": lr})

    def step(self, closure: None = None) -> None:  # type: ignore[override]
        step_together([self])

    def momentum(self, weight: Tensor) -> Tensor:
        """The running mean of the gradients of a weight, which may be changed in place."""
        state = self.state[weight]
        if "momentum" not in state:
            state["momentum"] = torch.zeros_like(weight)
        return state["momentum"]


@torch.no_grad()
def step_together(optimizers: Sequence[torch.optim.Optimizer]) -> None:
    """A step of each optimiser, with the matrices of all instances of `Muon` in common operations."""
    muons = [one for one in optimizers if isinstance(one, Muon)]
    for other in optimizers:
        if not isinstance(other, Muon):
            other.step()
    owned = [(one, weight) for one in muons for weight in one.param_groups[0]["params"]]
    # Matrices of one shape are made orthogonal together, which costs less than one after another.
    for shape in dict.fromkeys(weight.shape for _, weight in owned):
        mine = [(one, weight) for one, weight in owned if weight.shape == shape]
        weights, gradients = [weight for _, weight in mine], [weight.grad for _, weight in mine]
        momenta = [one.momentum(weight) for one, weight in mine]
        torch._foreach_lerp_(momenta, gradients, 1 - MOMENTUM)
        # Nesterov's momentum, after the gradient has been added to it.
        directions = orthogonal(torch.stack(torch._foreach_lerp(gradients, momenta, MOMENTUM)))
        out, into = shape[-2:]
        rates = [one.param_groups[0]["lr"] for one, _ in mine]
        lengths = RATE * max(1.0, out / into) ** 0.5 * _column(rates, directions)
        torch._foreach_sub_(weights, (directions * lengths).unbind())


def _column(numbers: Sequence[float | Tensor], like: Tensor) -> Tensor:
    """Numbers, or tensors () on a device, as a tensor (N, 1, ...) with the axes of another."""
    tensors = [number for number in numbers if isinstance(number, Tensor)]
    column = torch.stack(tensors) if tensors else like.new_tensor(numbers)
    return column.reshape(-1, *[1] * (like.ndim - 1))


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
