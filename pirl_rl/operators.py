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

With many noise channels the trace is estimated. For a random vector xi in R^w with E[xi xi^T] = I, a probe,

    E[(sigma xi)^T hess V (sigma xi)] = Tr(sigma sigma^T hess V)

(M. F. Hutchinson, Communications in Statistics - Simulation and Computation 18(3), 1989; for the residuals of networks
Z. Hu, Z. Shi, G. E. Karniadakis, K. Kawaguchi, Hutchinson Trace Estimation for high-dimensional and high-order PINNs,
2024). The one column sigma xi takes the place of the w columns of sigma. Each of k probes has a column and a drift of
its own, which costs as much as 1 + 2 k forward passes. Its L^u V is unbiased, but the square of it is not: for two
independent probes E[L_1 L_2] = (L^u V)^2, whereas E[L_1^2] is larger by the variance of L_1.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.layers import Dense, Levels, LogLevels, Periodic, RootTime, Scaling
from pirl_rl.networks import CriticValue
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sigma import times

ValueFunction = Callable[[Tensor, Tensor], Tensor]

BITS = 62
"""The number of random signs in a random integer."""


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


def generator(
    value: ValueFunction, problem: ReachAvoidProblem, tau: Tensor, x: Tensor, u: Tensor, probes: Tensor | None = None
) -> Tensor:
    """L^u V at points, Eq. (parabolic_operator).

    Args:
        value: V, which maps (N,) and (N, n) to (N,); for `critic.at(action)` it is computed by Ito propagation.
        problem: gives f and sigma.
        tau: times to go (N,), in s.
        x: states (N, n).
        u: physical controls (N, m), the arguments of f and sigma; the result is differentiable in them.
        probes: random vectors (k, N, w), see `rademacher`, each of which gives an unbiased estimate of L^u V; without
            them the result is exact.

    Returns:
        L^u V (N,), in 1/s, or (critics, N) for a critic with stacked parameters; with probes (k, N) or (critics, k, N).
    """
    sigma = problem.diffusion(x, u)
    if probes is not None:
        return _along(value, tau, x, problem.drift(x, u), times(sigma, probes).unsqueeze(1))
    return _along(value, tau, x, problem.drift(x, u), sigma.movedim(-1, 0).unsqueeze(0)).squeeze(-2)


def advection(value: ValueFunction, problem: ReachAvoidProblem, tau: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """-d_tau V + f(x, u) . grad_x V; arguments and shapes are those of `generator`.

    If sigma does not depend on u, this differs from L^u V by a term without u.
    """
    return _along(value, tau, x, problem.drift(x, u), x.new_zeros((1, 0, *x.shape))).squeeze(-2)


def rademacher(count: int, x: Tensor, channels: int) -> Tensor:
    """Probes (count, N, channels) for states x (N, n): independent signs -1 and 1, from the default random generator.

    Among all laws of independent entries they give the trace the smallest variance; for one channel it is exact.
    """
    # The bits of random integers take a tenth of the time of as many random numbers.
    widths = [min(BITS, channels - first) for first in range(0, channels, BITS)]
    bits = [
        torch.randint(2**BITS, (count, len(x), 1), device=x.device) >> torch.arange(width, device=x.device) & 1
        for width in widths
    ]
    return torch.cat(bits, -1).to(x.dtype).mul_(2).sub_(1)


def _along(value: ValueFunction, tau: Tensor, x: Tensor, f: Tensor, columns: Tensor) -> Tensor:
    """The drifts (*, k, N) of V along k SDEs with one f (N, n), each with c columns of noise, (k, c, N, n) together."""
    if isinstance(value, CriticValue):
        return _ito_drift(value, tau, x, f, columns)
    return _forward_mode(value, tau, x, f, columns)


def _ito_drift(value: CriticValue, tau: Tensor, x: Tensor, f: Tensor, columns: Tensor) -> Tensor:
    z = value.critic.inputs(tau.unsqueeze(-1), x, value.action)
    rest = z.shape[-1] - 1 - x.shape[-1]
    a = nn.functional.pad(torch.cat([-torch.ones_like(tau).unsqueeze(-1), f], -1), (0, rest))
    a, s = a.expand(len(columns), *a.shape), nn.functional.pad(columns, (1, rest))
    for layer in value.critic.layers:
        z, a, s = _propagate(layer, z, a, s)
    return a.squeeze(-1)


def _propagate(layer: nn.Module, z: Tensor, a: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Map the value z (*, N, d), k drifts a (*, k, N, d) and their columns s (*, k, c, N, d) through one layer."""
    if isinstance(layer, RootTime):
        # d sqrt(tau + tau_0) = d tau / (2 sqrt(tau + tau_0)), and tau has no noise.
        root = layer(z)
        rate = (1 / (2 * root[..., -1:])).unsqueeze(-3)
        return root, torch.cat([a, a[..., :1] * rate], -1), nn.functional.pad(s, (0, 1))
    if isinstance(layer, Levels):
        rate, kicks = _along_levels(layer.levels, *(layer.of(entry) for entry in (z, a, s)))
        return layer(z), torch.cat([a, rate], -1), torch.cat([s, kicks], -1)
    if isinstance(layer, LogLevels):
        _, slope, curvature = layer.logs(layer.of(z))
        slope, curvature = slope.unsqueeze(-3), curvature.unsqueeze(-3)
        rate = slope * layer.of(a) + curvature * layer.of(s).square().sum(-3) / 2
        kicks = slope.unsqueeze(-3) * layer.of(s)
        a, s = a.expand(*rate.shape[:-1], -1), s.expand(*kicks.shape[:-1], -1)
        return layer(z), torch.cat([a, rate], -1), torch.cat([s, kicks], -1)
    if isinstance(layer, Scaling):
        return layer(z), a * layer.scale[..., None, None, :], s * layer.scale[..., None, None, None, :]
    if isinstance(layer, Dense):
        weight = layer.weight.mT
        drifts = torch.matmul(a.flatten(-3, -2), weight).unflatten(-2, a.shape[-3:-1])
        columns = torch.matmul(s.flatten(-4, -2), weight).unflatten(-2, s.shape[-4:-1])
        return layer(z), drifts, columns
    if isinstance(layer, Periodic):
        z, a, s = layer.widened(z), layer.widened(a), layer.widened(s)
        y, slope, curvature = layer.waves(z)
    else:
        y, slope, curvature = ACTIVATIONS[type(layer)](z)
    slope, curvature = slope.unsqueeze(-3), curvature.unsqueeze(-3)
    return y, slope * a + curvature * s.square().sum(-3) / 2, slope.unsqueeze(-3) * s


def _along_levels(levels: Callable[[Tensor], Tensor], x: Tensor, f: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """The drifts (k, N, j) and columns (k, c, N, j) of j levels at x (N, n), along f (k, N, n) and (k, c, N, n)."""

    def along(tangent: Tensor) -> Callable[[Tensor], Tensor]:
        return lambda y: torch.func.jvp(levels, (y,), (tangent,))[1]

    def twice(column: Tensor) -> tuple[Tensor, Tensor]:
        return torch.func.jvp(along(column), (x,), (column,))[:2]

    rate = torch.func.vmap(lambda drift: along(drift)(x))(f)
    if not columns.shape[1]:
        return rate, rate.new_zeros((len(f), 0, *rate.shape[1:]))
    # The columns are an axis of `vmap` and not of the states: the compiler's nested forward mode fails where a level
    # broadcasts a constant over the states, as in x * c.
    kicks, curvatures = (part.unflatten(0, columns.shape[:2]) for part in torch.func.vmap(twice)(columns.flatten(0, 1)))
    return rate + curvatures.sum(1) / 2, kicks


def _forward_mode(value: ValueFunction, tau: Tensor, x: Tensor, f: Tensor, columns: Tensor) -> Tensor:
    def along(tangent_tau: Tensor, tangent_x: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda t, y: torch.func.jvp(value, (t, y), (tangent_tau, tangent_x))[1]

    def second(column: Tensor) -> Tensor:
        return torch.func.jvp(along(still, column), (tau, x), (still, column))[1]

    first, still = along(-torch.ones_like(tau), f)(tau, x), torch.zeros_like(tau)
    return torch.stack([sum((second(column) / 2 for column in own), first) for own in columns], -2)


def require_twice_differentiable(layers: nn.Sequential) -> None:
    """Refuse a network whose second derivatives do not exist or that Ito propagation does not support.

    Raises:
        ArgumentError: an activation is not one of `ACTIVATIONS`.
    """
    for layer in layers:
        if (
            not isinstance(layer, (Levels, LogLevels, RootTime, Scaling, Periodic, Dense))
            and type(layer) not in ACTIVATIONS
        ):
            known = ", ".join(sorted(kind.__name__ for kind in ACTIVATIONS))
            raise ArgumentError(
                f"critic: the HJB residual takes second derivatives, so every activation must be C^2; "
                f"expected one of {known}, got {type(layer).__name__}"
            )


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """The mean of the values (*) where the mask (*) is true, or 0 if it is true nowhere; the shapes are static."""
    return torch.where(mask, values, torch.zeros_like(values)).sum() / mask.sum().clamp(min=1)
