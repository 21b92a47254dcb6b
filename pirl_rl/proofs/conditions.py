"""The conditions under which a function W is a lower bound of a policy's probability of success.

Let W(tau, x) = w(tau, x) - c be continuously differentiable once in tau and twice in x on a box of states D, and let

    L^pi W >= 0        where W > 0, outside A and B,                        (interior)
    W <= 1             on the face of A, and at tau = 0 in an invariance problem,
    W <= 0             on the face of B, on the sides of D, and otherwise at tau = 0.

Then the probability of success of the policy pi under continuous feedback is at least W(tau, x): by Ito's formula
W(tau - t, X_t) is a submartingale up to the first time t at which the path meets A, B, a side of D, the end of time, or
W <= 0, and its value there is at most the payoff. No condition is needed on parts of sides that paths cannot reach from
inside: where a coordinate has no noise and its drift points inward.

Here w is a spline, and c >= 0 the margin. For each condition and box, the least margin with which it holds there is
bounded from above: a condition that fails on a box holds for a margin that is not below w.

Each condition is bounded on boxes. Drift, noise and the policy's networks are enclosed by affine forms of the box's
coordinates, W by polynomials, and L^pi W by their products.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs.affine import Affine
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.polynomials import Polynomials, TaylorModel
from pirl_rl.proofs.search import CHUNK
from pirl_rl.proofs.spline import Spline

Feedback = Callable[[Affine, Affine], Affine]
"""Maps tau (N,) and x (N, n), as affine forms, to the control (N, m) in SI units."""

SLAB = 1e-9
"""Zeros of a level within this share of the width of D from a side lie on the side, as far as it concerns a proof.

The bound is not about states that are this close to a side.
"""

CAUTION = 1e-12
"""By this the parts of boxes that contain the zeros of a level are widened, for rounding."""

FLAT = 1e-300
"""A slope that is not above this says nothing about where a level is 0."""


@dataclass(frozen=True)
class Conditions:
    """The conditions for a problem, a policy and W.

    Args:
        problem: the physics.
        feedback: the policy on affine forms.
        spline: w.
        margin: the least margin of interest.
    """

    problem: ReachAvoidProblem
    feedback: Feedback
    spline: Spline
    margin: float

    @property
    def _physics(self) -> Any:
        """The problem, whose methods take affine forms as they take tensors."""
        return self.problem

    def interior(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """The margins with which L^pi W >= 0 on boxes, or W <= 0, or they lie in A or in B; and the axes to halve."""
        w, z = self.spline.on(boxes), boxes.coordinates()
        margin = w.model().bounds()[1].masked_fill(self._elsewhere(z[:, 1:]), 0.0)
        axis = torch.zeros(len(boxes), dtype=torch.long)
        rest = (margin > self.margin).nonzero().squeeze(-1)
        if len(rest):
            residual = self._residual(w.at(rest), z[rest])
            margin[rest] = torch.where(residual.bounds()[0] >= 0, 0.0, margin[rest])
            # The remainder comes from the physics and the policy, whose change along each axis is not known.
            axis[rest] = (residual.variation() + residual.remainder * boxes.share[rest].T).argmax(0)
        return margin, axis

    def residual(self, boxes: Boxes) -> Tensor:
        """A lower bound (N,) of L^pi W on boxes, in 1/s."""
        parts = boxes.split(CHUNK)
        return torch.cat([self._residual(self.spline.on(part), part.coordinates()).bounds()[0] for part in parts])

    def start(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """The margins with which W is at most the payoff at tau = 0, on boxes whose first coordinate is 0."""
        value = self.spline.on(boxes).model()
        if self.problem.objective == "invariance":
            return value.bounds()[1] - 1, _widest(value)
        return value.bounds()[1].masked_fill(self._elsewhere(boxes.coordinates()[:, 1:]), 0.0), _widest(value)

    def side(self, boxes: Boxes, axis: int, outward: int) -> tuple[Tensor, Tensor]:
        """The margins with which W <= 0 on boxes in a side of D that are outside A and B, and reached from inside."""
        value = self.spline.on(boxes).model()
        free = self._elsewhere(boxes.coordinates()[:, 1:]) | self._unreached(boxes, axis, outward)
        return value.bounds()[1].masked_fill(free, 0.0), _widest(value)

    def face(self, boxes: Boxes, constraints: Callable, number: int, most: float) -> tuple[Tensor, Tensor]:
        """The margins with which W <= most at the zeros of a constraint in boxes that paths reach from inside."""
        none, part = _zeros(boxes, constraints(boxes.coordinates()[:, 1:])[:, number])
        value = self.spline.on(part).model()
        margin = (value.bounds()[1] - most).masked_fill(none, 0.0)
        for axis, edges in enumerate(part.edges[1:], 1):
            width = float(edges[-1] - edges[0])
            for outward, end in ((-1, edges[0]), (1, edges[-1])):
                farthest = (part.centre[:, axis] - end).abs() + part.half_width[:, axis]
                on_side = ((margin > 0) & (farthest <= SLAB * width)).nonzero().squeeze(-1)
                if len(on_side):
                    unreached = self._unreached(part[on_side], axis - 1, outward)
                    margin[on_side] = margin[on_side].masked_fill(unreached, 0.0)
        return margin, _widest(value)

    def _elsewhere(self, x: Affine) -> Tensor:
        """Whether boxes lie in A or in B (N,)."""
        result = torch.zeros(len(x), dtype=torch.bool)
        if self.problem.objective == "reach-avoid":
            result = result | (Affine.of(self._physics.reached_constraints(x), x).high <= 0).all(-1)
        if self.problem.has_avoid_set:
            result = result | (Affine.of(self._physics.avoid_constraints(x), x).high <= 0).any(-1)
        return result

    def _unreached(self, boxes: Boxes, axis: int, outward: int) -> Tensor:
        """Whether no path moves outward along a coordinate on boxes: it has no noise, and its drift points inward."""
        z = boxes.coordinates()
        u = self.feedback(z[:, 0], z[:, 1:])
        inward = (Affine.of(self._physics.drift(z[:, 1:], u), z)[:, axis] * -float(outward)).low > 0
        noise = _product(self._physics.diffusion(z[:, 1:], u), axis, axis)
        return inward if noise is None else torch.zeros_like(inward)

    def _residual(self, w: Polynomials, z: Affine) -> TaylorModel:
        """L^pi W on boxes with coordinates z (N, d)."""
        x = z[:, 1:]
        u = self.feedback(z[:, 0], x)
        f, sigma = Affine.of(self._physics.drift(x, u), x), self._physics.diffusion(x, u)
        result = -w.derivative(0).model()
        for i in range(self.problem.states.dim):
            slope = w.derivative(1 + i)
            result = result + slope.model() * f[:, i]
            for j in range(i, self.problem.states.dim):
                covariance = _product(sigma, i, j)
                if covariance is not None:
                    factor = Affine.of(covariance * (0.5 if i == j else 1.0), x)
                    result = result + slope.derivative(1 + j).model() * factor
        return result


def _zeros(boxes: Boxes, level: Affine) -> tuple[Tensor, Boxes]:
    """Whether a level (N,) is not 0 on boxes, and the parts of the boxes that contain all its zeros."""
    spread = level.spread + CAUTION * level.magnitude
    none = level.centre.abs() > spread
    low, high = [], []
    for slope in level.slopes:
        # |centre + slope e| <= the spread of all other terms.
        others = (spread - slope.abs()).clamp(min=0)
        flat = slope.abs() <= FLAT
        safe = torch.where(flat, torch.ones_like(slope), slope)
        middle, reach = -level.centre / safe, others / safe.abs()
        low.append(torch.where(flat, -1.0, (middle - reach - CAUTION)).clamp(-1, 1))
        high.append(torch.where(flat, 1.0, (middle + reach + CAUTION)).clamp(-1, 1))
    return none, boxes.part(torch.stack(low, -1), torch.stack(high, -1))


def _widest(value: TaylorModel) -> Tensor:
    return value.variation().argmax(0)


def _product(sigma: Affine | Tensor, i: int, j: int) -> Affine | Tensor | None:
    """The entry (N,) of sigma sigma^T; None where it is 0 in all boxes."""
    rows = sigma[:, i], sigma[:, j]
    if isinstance(sigma, Tensor):
        product = (rows[0] * rows[1]).sum(-1)
        return product if bool(product.any()) else None
    return (rows[0] * rows[1]).sum(-1)
