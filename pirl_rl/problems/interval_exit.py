"""The probability that a diffusion in one dimension leaves an interval at its left end, within a given time.

The diffusion dR = b(R) dt + dB has the generator L v = (m v')'/(2 m) with the speed density m, where log m has the
derivative 2 b (Karatzas and Shreve, Brownian Motion and Stochastic Calculus, Sec. 5.5.B). The probability v(tau, r) of
its exit solves v_tau = L v with v = 1 at the left end, v = 0 at the right end, and v = 0 at tau = 0 between them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.polynomial import legendre
from scipy.linalg import eigh
from torch import Tensor

DEGREE = 64
"""The degree of the polynomials in r that represent the solution."""


class IntervalExit:
    """v(tau, r) = p(r) - sum_k c_k exp(-l_k tau) e_k(r), with p the probability for unlimited time.

    L is self-adjoint in the inner product with the weight m, so that eigenvalues -l_k and eigenfunctions e_k come from
    Galerkin's method with polynomials that vanish at both ends (J. Shen, SIAM J. Sci. Comput. 15, 1994). The method is
    exact in tau and its error in r falls exponentially with `DEGREE`; only at tau of about 1e-4 (right - left)^2 and
    below the series is too short.

    Args:
        log_speed: maps points (k,) of the interval to log m (k,), up to a constant.
        left: the left end of the interval.
        right: the right end of the interval.
    """

    def __init__(self, log_speed: Callable[[Tensor], Tensor], left: float, right: float):
        self.left, self.right = left, right
        half = (right - left) / 2
        z, weights = legendre.leggauss(2 * DEGREE)
        log_m = log_speed(torch.from_numpy(left + half * (z + 1))).numpy()
        m = np.exp(log_m - log_m.mean())
        # In the coordinate z in [-1, 1], P_j - P_(j+2) vanishes at both ends.
        basis = np.eye(DEGREE - 1, DEGREE + 1) - np.eye(DEGREE - 1, DEGREE + 1, 2)
        values = legendre.legval(z, basis.T)
        slopes = legendre.legval(z, legendre.legder(basis, axis=1).T)
        mass = half * (values * weights * m) @ values.T
        stiffness = (slopes * weights * m) @ slopes.T / (2 * half)
        rates, vectors = eigh(stiffness, mass)
        # p' is a multiple of -1/m, because L p = 0.
        fit = legendre.legfit(z, 1 / m, DEGREE - 1)
        integral = legendre.legint(fit, lbnd=1)
        forever = integral / legendre.legval(-1.0, integral)
        start = vectors.T @ (half * (values * weights * m) @ legendre.legval(z, forever))
        self._rates, self._forever = torch.from_numpy(rates), torch.from_numpy(forever)
        self._modes = torch.from_numpy(start[:, None] * (vectors.T @ basis))

    def __call__(self, tau: Tensor, r: Tensor) -> Tensor:
        """v (*) at times tau (*) and points r (*); 1 left of the interval and 0 right of it."""
        inside = (r > self.left) & (r < self.right) & (tau > 0)
        middle = (self.left + self.right) / 2
        # Points outside get other arguments, so that polynomials stay bounded.
        z = (torch.where(inside, r, torch.full_like(r, middle)).double() - middle) * 2 / (self.right - self.left)
        decay = torch.exp(-tau.double().unsqueeze(-1) * self._rates.to(tau.device))
        coefficients = self._forever.to(tau.device) - decay @ self._modes.to(tau.device)
        value = (coefficients * _polynomials(z)).sum(-1)
        return torch.where(inside, value.to(r.dtype), (r <= self.left).to(r.dtype))


def _polynomials(z: Tensor) -> Tensor:
    """Legendre's polynomials P_0 to P_DEGREE (*, DEGREE + 1) at z (*), by their recurrence."""
    rows = [torch.ones_like(z), z]
    for j in range(1, DEGREE):
        rows.append(((2 * j + 1) * z * rows[j] - j * rows[j - 1]) / (j + 1))
    return torch.stack(rows, -1)
