"""The conditions under which a function W is a lower bound of a probability.

Let W(tau, x) = w(tau, x) - c be continuously differentiable once in tau and twice in x on a box of states D. It is a
lower bound of the probability of success of a policy pi under continuous feedback if

    L^pi W >= 0        where W > 0, outside A and B,                        (interior)
    W <= 1             on the face of A, and at tau = 0 in an invariance problem,
    W <= 0             on the face of B, on the sides of D, and otherwise at tau = 0.

By Ito's formula W(tau - t, X_t) is then a submartingale up to the first time t at which the path meets A, B, a side of
D, the end of time, or W <= 0, and its value there is at most the payoff.

It is a lower bound of the probability of failure under every policy, also one with a memory or with a randomness of its
own, if

    L^u W >= 0         for all admissible controls u where W > 0, outside A and B,
    W <= 1             on the face of B, and at tau = 0 in a reach-avoid problem,
    W <= 0             on the face of A, on the sides of D, and otherwise at tau = 0,

since the same formula holds along the path of every control process. So 1 - W is an upper bound of V.

No condition is needed on parts of sides that paths cannot reach from inside: where a coordinate has no noise and its
drift points inward, for all controls in the second case.

Here w is a spline, and c >= 0 the margin. For each condition and box, the least margin with which it holds there is
bounded from above: a condition that fails on a box holds for a margin that is not below w.

Each condition is bounded on boxes. Drift, noise and the policy's networks are enclosed by affine forms of the box's
coordinates, W by polynomials, and L^u W by their products. For all controls, boxes have the controls as coordinates
after tau and x. Then L^u W = g_0 + sum_i g_i e_i with the coordinate e_i in [-1, 1] of the control u_i and functions
g_i of tau and x, and what is not affine in u is in the remainder of g_0. The least value is g_0 - sum_i |g_i|, whose
effort is proportional to the number of controls. Where g_i may be 0 in a box, |g_i| is replaced by a chord above it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pirl_rl.proofs.affine import Affine
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.ends import Absorbing, Ends
from pirl_rl.proofs.polynomials import Polynomials, TaylorModel
from pirl_rl.proofs.search import CHUNK
from pirl_rl.proofs.spline import Spline

Feedback = Callable[[Affine], Affine]
"""Maps the coordinates (N, d) of boxes, tau and x before all others, to the control (N, m) in SI units."""

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
    """The conditions for a problem, a control and W.

    Args:
        ends: the problem, and what W may be where paths end.
        feedback: the policy on affine forms, or the coordinates that are controls.
        spline: w.
        margin: the least margin of interest.
    """

    ends: Ends
    feedback: Feedback
    spline: Spline
    margin: float

    @property
    def _physics(self) -> Any:
        """The problem, whose methods take affine forms as they take tensors."""
        return self.ends.problem

    @property
    def _own(self) -> int:
        """The number of coordinates of W, which are tau and x; controls follow them."""
        return len(self.spline.edges)

    def _states(self, z: Affine) -> Affine:
        return z[:, 1 : self._own]

    def interior(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """The margins with which L^u W >= 0 on boxes, or W <= 0, or they lie in A or in B; and the axes to halve."""
        w, z = self.spline.on(boxes), boxes.coordinates()
        margin = w.model().bounds()[1].masked_fill(self._elsewhere(self._states(z)), 0.0)
        axis = torch.zeros(len(boxes), dtype=torch.long)
        rest = (margin > self.margin).nonzero().squeeze(-1)
        if len(rest):
            low, weights = self._least(w.at(rest), z[rest], boxes.share[rest].T)
            margin[rest] = torch.where(low >= 0, 0.0, margin[rest])
            axis[rest] = weights.argmax(0)
        return margin, axis

    def residual(self, boxes: Boxes) -> Tensor:
        """A lower bound (N,) of L^u W on boxes, in 1/s."""
        parts = boxes.split(CHUNK)
        return torch.cat([self._least(self.spline.on(part), part.coordinates(), part.share.T)[0] for part in parts])

    def start(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """The margins with which W is at most what is paid at tau = 0, on boxes whose first coordinate is 0."""
        value = self.spline.on(boxes).model()
        elsewhere = self._elsewhere(self._states(boxes.coordinates()))
        return (value.bounds()[1] - self.ends.at_start).masked_fill(elsewhere, 0.0), _widest(value)

    def side(self, boxes: Boxes, axis: int, outward: int) -> tuple[Tensor, Tensor]:
        """The margins with which W <= 0 on boxes in a side of D that are outside A and B, and reached from inside."""
        value = self.spline.on(boxes).model()
        free = self._elsewhere(self._states(boxes.coordinates())) | self._unreached(boxes, axis, outward)
        return value.bounds()[1].masked_fill(free, 0.0), _widest(value)

    def face(self, boxes: Boxes, absorbing: Absorbing, number: int) -> tuple[Tensor, Tensor]:
        """The margins with which W is at most what is paid at the zeros of a level of a set that paths reach.

        Where a path meets an intersection, no level is positive, and where it meets a union, none is negative.
        """
        z = boxes.coordinates()
        levels = Affine.of(absorbing.levels(self._states(z)), z)
        none, part = _zeros(boxes, levels[:, number])
        none = none | ((levels.low > 0) if absorbing.intersection else (levels.high < 0)).any(-1)
        value = self.spline.on(part).model()
        margin = (value.bounds()[1] - absorbing.most).masked_fill(none, 0.0)
        for axis, edges in enumerate(self.spline.edges[1:], 1):
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
        if self.ends.has_target:
            result = result | (Affine.of(self.ends.target(x), x).high <= 0).all(-1)
        if self.ends.problem.has_avoid_set:
            result = result | (Affine.of(self.ends.avoid(x), x).high <= 0).any(-1)
        return result

    def _unreached(self, boxes: Boxes, axis: int, outward: int) -> Tensor:
        """Whether no path moves outward along a coordinate on boxes: it has no noise, and its drift points inward."""
        z = boxes.coordinates()
        x, u = self._states(z), self.feedback(z)
        inward = (Affine.of(self._physics.drift(x, u), z)[:, axis] * -float(outward)).low > 0
        noise = _product(self._physics.diffusion(x, u), axis, axis)
        return inward if noise is None else torch.zeros_like(inward)

    def _least(self, w: Polynomials, z: Affine, share: Tensor) -> tuple[Tensor, Tensor]:
        """A lower bound (N,) of L^u W on boxes, and the use (d, N) of halving them along each coordinate.

        Args:
            w: W on the boxes.
            z: the coordinates (N, d) of the boxes.
            share: the shares (d, N) of the boxes in their cells.
        """
        result, signs = self._residual(w, z)
        low, own = result.bounds()[0], self._own
        # The remainder comes from the physics and the policy, whose change along each axis is not known.
        weights = torch.cat([result.variation() + signs, torch.zeros_like(share[own:])]) + result.remainder * share
        if len(share) > own:
            # That of the controls is what is left for a single state.
            slopes = z.slopes.clone()
            slopes[:own] = 0
            bent = self._residual(w, Affine(z.centre, slopes, torch.zeros_like(z.radius)))[0].remainder
            weights[own:] = bent * share[own:]
        return low, weights

    def _residual(self, w: Polynomials, z: Affine) -> tuple[TaylorModel, Tensor]:
        """A lower bound of L^u W on boxes with coordinates z (N, d), and the variation of what is bounded by chords."""
        terms = list(self._terms(w, z))
        result, own = -w.derivative(0).model(), self._own
        for derivative, factor in terms:
            result = result + derivative * Affine(factor.centre, factor.slopes[:own], factor.radius)
        signs = torch.zeros(own, len(z), dtype=torch.float64)
        for control in range(own, len(z.slopes)):
            gains = [
                (derivative, factor.slopes[control]) for derivative, factor in terms if factor.slopes[control].any()
            ]
            if gains:
                gain = _sum([derivative * Affine.of(slope, z) for derivative, slope in gains])
                below, undecided = gain.minus_absolute()
                result, signs = result + below, signs + gain.variation() * undecided
        return result, signs

    def _terms(self, w: Polynomials, z: Affine) -> Iterator[tuple[TaylorModel, Affine]]:
        """The slopes and curvatures of W, each with the affine form (N,) that multiplies it in L^u W."""
        x, u = self._states(z), self.feedback(z)
        f, sigma = Affine.of(self._physics.drift(x, u), x), self._physics.diffusion(x, u)
        for i in range(self.ends.problem.states.dim):
            slope = w.derivative(1 + i)
            yield slope.model(), f[:, i]
            for j in range(i, self.ends.problem.states.dim):
                covariance = _product(sigma, i, j)
                if covariance is not None:
                    yield slope.derivative(1 + j).model(), Affine.of(covariance * (0.5 if i == j else 1.0), x)


def _sum(models: Sequence[TaylorModel]) -> TaylorModel:
    result = models[0]
    for model in models[1:]:
        result = result + model
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
