"""The generator of the controlled SDE with the time to go as a part of the state, Eq. (parabolic_operator):

    L^u V = -d_tau V + f(x, u) . grad_x V + 1/2 Tr(sigma sigma^T hess_x V).

For the critics of this package it is computed by Ito propagation. Along dX = f dt + sigma dW, d tau = -dt, every
activation z of a network is an Ito process dz = a dt + s dW by Ito's lemma. The input (tau, x) has the drift
a = (-1, f) and one column s_j = (0, sigma_j) for each of the w noise channels. The layers map (z, a, s) as follows:

- an affine layer applies its weights to z, a and s, and its bias to z alone;
- the levels g of the sets are appended as the processes of Ito's lemma, grad g . a + 1/2 sum_j s_j^T hess g s_j and
  grad g . s, by the forward mode of `torch.func`;
- an activation phi gives (phi(z), phi'(z) a + 1/2 phi''(z) |s|^2, phi'(z) s); so do the sine and the cosine of a
  periodic coordinate.

The drift of the output is L^u V. This costs as much as 2 + w forward passes and builds no graph of derivatives, so that
it can be compiled and one backward pass gives the gradient in the parameters, through the Hessian too. Other callables
are differentiated by the forward mode of `torch.func`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.layers import Dense, Levels, Periodic, RootTime, Scaling
from pirl_rl.networks import CriticValue
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
"""phi, phi' and phi'' of the activations that Ito propagation supports; all are C^2, since L^u is of second order."""


def generator(value: ValueFunction, problem: ReachAvoidProblem, tau: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """L^u V at points, Eq. (parabolic_operator).

    Args:
        value: V, which maps (N,) and (N, n) to (N,); for `critic.at(action)` it is computed by Ito propagation.
        problem: gives f and sigma.
        tau: times to go (N,), in s.
        x: states (N, n).
        u: physical controls (N, m), the arguments of f and sigma; the result is differentiable in them.

    Returns:
        L^u V (N,), in 1/s, or (critics, N) for a critic with stacked parameters.
    """
    return _along(value, tau, x, problem.drift(x, u), problem.diffusion(x, u))


def advection(value: ValueFunction, problem: ReachAvoidProblem, tau: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """-d_tau V + f(x, u) . grad_x V; arguments and shapes are those of `generator`.

    If sigma does not depend on u, this differs from L^u V by a term without u.
    """
    return _along(value, tau, x, problem.drift(x, u), x.new_zeros((*x.shape, 0)))


def _along(value: ValueFunction, tau: Tensor, x: Tensor, f: Tensor, sigma: Tensor) -> Tensor:
    """The drift of V along the SDE with f (N, n) and sigma (N, n, w)."""
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
    """Map the value z (*, N, d), its drift a (*, N, d) and its columns s (*, w, N, d) through one layer."""
    if isinstance(layer, RootTime):
        # d sqrt(tau + tau_0) = d tau / (2 sqrt(tau + tau_0)), and tau has no noise.
        root = layer(z)
        rate = 1 / (2 * root[..., -1:])
        return root, torch.cat([a, a[..., :1] * rate], -1), nn.functional.pad(s, (0, 1))
    if isinstance(layer, Levels):
        rate, kicks = _along_levels(layer.levels, *(layer.of(entry) for entry in (z, a, s)))
        return layer(z), torch.cat([a, rate], -1), torch.cat([s, kicks], -1)
    if isinstance(layer, Scaling):
        return layer(z), a * layer.scale.unsqueeze(-2), s * layer.scale[..., None, None, :]
    if isinstance(layer, Dense):
        weight = layer.weight.mT
        columns = torch.matmul(s.flatten(-3, -2), weight).unflatten(-2, s.shape[-3:-1])
        return layer(z), torch.matmul(a, weight), columns
    if isinstance(layer, Periodic):
        z, a, s = layer.widened(z), layer.widened(a), layer.widened(s)
        y, slope, curvature = layer.waves(z)
    else:
        y, slope, curvature = ACTIVATIONS[type(layer)](z)
    return y, slope * a + curvature * s.square().sum(-3) / 2, slope.unsqueeze(-3) * s


def _along_levels(levels: Callable[[Tensor], Tensor], x: Tensor, f: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """The drift (N, k) and the columns (w, N, k) of levels at x (N, n), along f (N, n) and sigma (w, N, n)."""

    def along(function: Callable[[Tensor], Tensor], tangent: Tensor) -> Callable[[Tensor], Tensor]:
        return lambda y: torch.func.jvp(function, (y,), (tangent,))[1]

    rate = along(levels, f)(x)
    if not len(sigma):
        return rate, rate.new_zeros((0, *rate.shape))
    # All columns at once: a loop over them would be compiled column by column.
    everywhere, kick = x.repeat(len(sigma), 1, 1), along(levels, sigma)
    return rate + along(kick, sigma)(everywhere).sum(0) / 2, kick(everywhere)


def _forward_mode(value: ValueFunction, tau: Tensor, x: Tensor, f: Tensor, sigma: Tensor) -> Tensor:
    def along(tangent_tau: Tensor, tangent_x: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda t, y: torch.func.jvp(value, (t, y), (tangent_tau, tangent_x))[1]

    result = along(-torch.ones_like(tau), f)(tau, x)
    still = torch.zeros_like(tau)
    for column in sigma.unbind(-1):
        result = result + torch.func.jvp(along(still, column), (tau, x), (still, column))[1] / 2
    return result


def require_twice_differentiable(layers: nn.Sequential) -> None:
    """Refuse a network whose second derivatives do not exist or that Ito propagation does not support.

    Raises:
        ArgumentError: an activation is not one of `ACTIVATIONS`.
    """
    for layer in layers:
        if not isinstance(layer, (Levels, RootTime, Scaling, Periodic, Dense)) and type(layer) not in ACTIVATIONS:
            known = ", ".join(sorted(kind.__name__ for kind in ACTIVATIONS))
            raise ArgumentError(
                f"critic: the HJB residual takes second derivatives, so every activation must be C^2; "
                f"expected one of {known}, got {type(layer).__name__}"
            )


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """The mean of the values (*) where the mask (*) is true, or 0 if it is true nowhere; the shapes are static."""
    return torch.where(mask, values, torch.zeros_like(values)).sum() / mask.sum().clamp(min=1)
