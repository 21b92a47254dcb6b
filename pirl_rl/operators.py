"""The generator of the controlled SDE, Eq. (parabolic_operator):

    L^u V = -d_tau V + f(x, u) . grad_x V + 1/2 Tr(sigma sigma^T hess_x V).

Fast path. By Ito's lemma, along dX = f dt + sigma dW with the time to go running down, every activation z of a network
is itself an Ito process dz = a dt + s dW. Starting from the input (tau, x) with drift (-1, f) and one column
(0, sigma_j) per noise channel, layers carry (z, a, s):

- an affine map acts linearly on a and s and its bias on z alone;
- an activation phi gives (phi(z), phi'(z) a + 1/2 phi''(z) |s|^2, phi'(z) s).

The drift of the output is L^u V: the work of 2 + w forward passes and no graph of derivatives, so one backward pass
reaches the parameters through the Hessian, and the whole compiles. Any other callable goes through
forward-mode `torch.func`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.networks import CriticValue, Dense, RootTime, Scaling
from pirl_rl.problem import ReachAvoidProblem

ValueFunction = Callable[[Tensor, Tensor], Tensor]


def _tanh(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    y = torch.tanh(z)
    slope = 1 - y * y
    return y, slope, -2 * y * slope


def _sigmoid(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    y = torch.sigmoid(z)
    slope = y * (1 - y)
    return y, slope, slope * (1 - 2 * y)


def _silu(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    y, slope, curvature = _sigmoid(z)
    return z * y, y + z * slope, 2 * slope + z * curvature


def _softplus(z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    y, slope, _ = _sigmoid(z)
    return nn.functional.softplus(z), y, slope


ACTIVATIONS: dict[type[nn.Module], Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]] = {
    nn.Tanh: _tanh,
    nn.Sigmoid: _sigmoid,
    nn.SiLU: _silu,
    nn.Softplus: _softplus,
}
"""phi, phi', phi'' of every activation the fast path knows; all are C^2, as a second-order equation needs."""


def generator(value: ValueFunction, problem: ReachAvoidProblem, tau: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """L^u V at points.

    Args:
        value: V, (N,), (N, n) -> (N,); a critic bound by `critic.at(action)` takes the fast path, with a leading axis
            where its parameters are stacked.
        tau: time to go (N,), s.
        x: states (N, n).
        u: physical controls (N, m) of the drift and diffusion; a gradient may flow through them.

    Returns:
        (N,), or (critics, N), in 1/s.
    """
    return _along(value, tau, x, problem.drift(x, u), problem.diffusion(x, u))


def advection(value: ValueFunction, problem: ReachAvoidProblem, tau: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """-d_tau V + f(x, u) . grad_x V: all of L^u V that depends on u where the noise does not. As `generator`."""
    return _along(value, tau, x, problem.drift(x, u), x.new_zeros((*x.shape, 0)))


def _along(value: ValueFunction, tau: Tensor, x: Tensor, f: Tensor, sigma: Tensor) -> Tensor:
    if isinstance(value, CriticValue):
        return _ito_drift(value, tau, x, f, sigma)
    return _forward_mode(value, tau, x, f, sigma)


def _ito_drift(value: CriticValue, tau: Tensor, x: Tensor, f: Tensor, sigma: Tensor) -> Tensor:
    z = value.critic.inputs(tau.unsqueeze(-1), x, value.action)
    rest = z.shape[-1] - 1 - x.shape[-1]
    a = nn.functional.pad(torch.cat([-torch.ones_like(tau).unsqueeze(-1), f], -1), (0, rest))
    s = nn.functional.pad(sigma.movedim(-1, 0), (1, rest))
    for layer in value.critic.layers:
        z, a, s = _propagate(layer, z, a, s)
    return a.squeeze(-1)


def _propagate(layer: nn.Module, z: Tensor, a: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Carry value and drift (*, N, d) and columns (*, w, N, d) through one layer."""
    if isinstance(layer, RootTime):
        # d sqrt(tau + tau_0) = d tau / (2 sqrt(tau + tau_0)), and time has no noise.
        root = layer(z)
        rate = 1 / (2 * root[..., -1:])
        return root, torch.cat([a, a[..., :1] * rate], -1), nn.functional.pad(s, (0, 1))
    if isinstance(layer, Scaling):
        return layer(z), a * layer.scale.unsqueeze(-2), s * layer.scale[..., None, None, :]
    if isinstance(layer, Dense):
        weight = layer.weight.mT
        columns = torch.matmul(s.flatten(-3, -2), weight).unflatten(-2, s.shape[-3:-1])
        return layer(z), torch.matmul(a, weight), columns
    y, slope, curvature = ACTIVATIONS[type(layer)](z)
    return y, slope * a + curvature * s.square().sum(-3) / 2, slope.unsqueeze(-3) * s


def _forward_mode(value: ValueFunction, tau: Tensor, x: Tensor, f: Tensor, sigma: Tensor) -> Tensor:
    def along(tangent_tau: Tensor, tangent_x: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda t, y: torch.func.jvp(value, (t, y), (tangent_tau, tangent_x))[1]

    result = along(-torch.ones_like(tau), f)(tau, x)
    still = torch.zeros_like(tau)
    for column in sigma.unbind(-1):
        result = result + torch.func.jvp(along(still, column), (tau, x), (still, column))[1] / 2
    return result


def require_twice_differentiable(layers: nn.Sequential) -> None:
    """Refuse a network whose second derivatives do not exist or are not known to the fast path.

    Raises:
        ArgumentError: naming the layer and the activations that can stand in its place.
    """
    for layer in layers:
        if not isinstance(layer, (RootTime, Scaling, Dense)) and type(layer) not in ACTIVATIONS:
            known = ", ".join(sorted(kind.__name__ for kind in ACTIVATIONS))
            raise ArgumentError(
                f"critic: the HJB residual takes second derivatives, so every activation must be C^2; "
                f"expected one of {known}, got {type(layer).__name__}"
            )


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of the values where the mask is true, 0 where it nowhere is; shapes stay fixed, as a compiler likes it."""
    return torch.where(mask, values, torch.zeros_like(values)).sum() / mask.sum().clamp(min=1)
