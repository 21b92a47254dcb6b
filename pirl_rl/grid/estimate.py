"""The estimate of the error of a grid, from its solution and one with half as many points and steps.

The distance of both is the larger part of the error where the error falls with the distance of the nodes. What both
have in common does not show in it, and each of the other parts looks for one such error:

- V jumps, or nearly so, and both meshes smear the jump about the same place. In its middle both have about the mean of
  the two sides, so that the estimate is the largest in a neighbourhood of one cell of the coarse mesh.
- Where drift and noise act in turns, large second differences of V show a jump.
- Where they act at once, the scheme adds noise, and where this is stronger than that of the problem it smears V.
- In cells that a face cuts, both are near the value of the set close to the face.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.arguments import Policy
from pirl_rl.grid.field import Field
from pirl_rl.grid.transport import WEAK

NEIGHBOURHOOD = 2
"""The half width of the neighbourhood whose largest estimate counts, in cells: one cell of the coarse mesh."""


@dataclass(frozen=True)
class Estimate:
    """The estimate (P,) as a function of times to go tau (P,), in s, and of states x (P, n) within their periods.

    Attributes:
        fine: V of the solution.
        coarse: V with half as many points and steps.
        turns: whether drift and noise acted in turns.
        policy: that of the solution.
        gradient: maps tau and x to the gradient (P, n) of V in x, per unit of the state.
    """

    fine: Field
    coarse: Field
    turns: bool
    policy: Policy
    gradient: Callable[[Tensor, Tensor], Tensor]

    def __call__(self, tau: Tensor, x: Tensor) -> Tensor:
        """The largest of the estimates at x and, along each axis, one cell of the coarse mesh to both sides."""
        problem, error = self.fine.problem, self.at(tau, x)
        for step in self._along_axes(x):
            for beside in (x - NEIGHBOURHOOD * step, x + NEIGHBOURHOOD * step):
                y = problem.states.wrap(beside)
                error = torch.maximum(error, self.at(tau, y).where(problem.interior(y), 0.0))
        return error

    def at(self, tau: Tensor, x: Tensor) -> Tensor:
        """The largest (P,) of the parts of the estimate at x alone."""
        error = self.distance(tau, x)
        if self.turns:
            return torch.maximum(error, self.bend(tau, x))
        cut, mesh = ~self.coarse.uncut(x), self.fine.mesh
        for nodes in mesh.corners(x[cut].detach().double().cpu().numpy())[0]:
            corners = torch.from_numpy(mesh.states(mesh.indices()[nodes])).to(x)
            distance = self.distance(tau[cut], corners).where(self.fine.problem.interior(corners), 0.0)
            error[cut] = torch.maximum(error[cut], distance)
        return torch.maximum(error, self.smear(tau, x))

    def distance(self, tau: Tensor, x: Tensor) -> Tensor:
        """The distance (P,) of the interpolated V from that of the coarse solution."""
        return (self.fine(tau, x) - self.coarse(tau, x)).abs()

    def smear(self, tau: Tensor, x: Tensor) -> Tensor:
        """The deviation (P,) of V under the noise that the scheme adds, where along the slope of V it is the stronger.

        Upwind jumps along axis i, with nodes h_i apart, add noise of the variance h_i |f_i| per unit of time, and
        implicit steps of the length dt add (f dt)^2 in each of them.
        """
        problem, control, slope = self.fine.problem, self.policy(tau, x), self.gradient(tau, x)
        drift, sigma = problem.drift(x, control), problem.diffusion(x, control)
        jumps = (torch.as_tensor(self.fine.mesh.spacing).to(x) * drift.abs() * slope.square()).sum(-1)
        noise = (sigma * slope.unsqueeze(-1)).sum(-2).square().sum(-1)
        # The steps are equidistant in sqrt(tau).
        dt = 2 * (tau * problem.horizon).sqrt() / (len(self.fine.values) - 1)
        deviation = (tau * (jumps + dt * (drift * slope).sum(-1).square())).sqrt()
        # Inside a set the physics may have no number, and there V is known.
        return deviation.where(jumps > WEAK * noise, 0.0).nan_to_num(0.0)

    def bend(self, tau: Tensor, x: Tensor) -> Tensor:
        """The largest second difference (P,) of V, of those along the axes at x and one cell beside it."""
        largest, wrap = torch.zeros_like(tau, dtype=x.dtype), self.fine.problem.states.wrap
        for step in self._along_axes(x):
            line = [self.fine(tau, wrap(x + k * step)) for k in range(-2, 3)]
            for behind, middle, ahead in zip(line, line[1:], line[2:], strict=False):
                largest = torch.maximum(largest, (ahead - 2 * middle + behind).abs())
        return largest

    def _along_axes(self, x: Tensor) -> Tensor:
        """The steps (n, n) from a node to the next one along each axis."""
        return torch.diag(torch.as_tensor(self.fine.mesh.spacing).to(x))
