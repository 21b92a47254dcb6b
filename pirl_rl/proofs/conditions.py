"""The conditions under which a function W is a lower bound of a policy's probability of success.

Let W(tau, x) be continuously differentiable once in tau and twice in x on a box of states D, and let

    L^pi W >= 0        where W > 0, outside A and B,                        (interior)
    W <= 1             on the face of A, and at tau = 0 in an invariance problem,
    W <= 0             on the face of B, on the sides of D, and otherwise at tau = 0.

Then the probability of success of the policy pi under continuous feedback is at least W(tau, x): by Ito's formula
W(tau - t, X_t) is a submartingale up to the first time t at which the path meets A, B, a side of D, the end of time, or
W <= 0, and its value there is at most the payoff. No condition is needed on parts of a side that paths cannot reach
from inside: where a coordinate has no noise and its drift points inward.

Each condition is bounded on boxes by affine forms, through the drift, the noise and the networks of the policy.
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
from pirl_rl.proofs.search import CHUNK
from pirl_rl.proofs.spline import Polynomials, Spline

Feedback = Callable[[Affine, Affine], Affine]
"""Maps tau (N,) and x (N, n), as affine forms, to the control (N, m) in SI units."""


@dataclass(frozen=True)
class Conditions:
    """The conditions for a problem, a policy and W.

    Args:
        problem: the physics.
        feedback: the policy on affine forms.
        spline: W + margin.
        margin: a number that is taken from the spline.
    """

    problem: ReachAvoidProblem
    feedback: Feedback
    spline: Spline
    margin: float = 0.0

    @property
    def _physics(self) -> Any:
        """The problem, whose methods take affine forms as they take tensors."""
        return self.problem

    def interior(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """Whether L^pi W >= 0 on boxes, or W <= 0, or they lie in A or in B; and the axis to halve."""
        polynomials = self.spline.on(boxes)
        z = boxes.coordinates()
        proved = self._elsewhere(z[:, 1:]) | (polynomials.enclosure().high <= self.margin)
        axis = torch.zeros(len(boxes), dtype=torch.long)
        rest = (~proved).nonzero().squeeze(-1)
        if len(rest):
            residual, weights = self._residual(boxes[rest], polynomials.at(rest), z[rest])
            proved[rest] = residual.low >= 0
            axis[rest] = weights.argmax(0)
        return proved, axis

    def residual(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """L^pi W at the centres of boxes (N,), and a lower bound of it on them (N,), in 1/s.

        Both are infinite on boxes where no condition holds.
        """
        centre, low = [], []
        for first in range(0, len(boxes), CHUNK):
            part = boxes[slice(first, first + CHUNK)]
            polynomials, z = self.spline.on(part), part.coordinates()
            free = self._elsewhere(z[:, 1:]) | (polynomials.enclosure().high <= self.margin)
            form = self._residual(part, polynomials, z)[0]
            centre.append(form.centre.masked_fill(free, torch.inf))
            low.append(form.low.masked_fill(free, torch.inf))
        return torch.cat(centre), torch.cat(low)

    def _elsewhere(self, x: Affine) -> Tensor:
        """Whether boxes lie in A or in B (N,)."""
        result = torch.zeros(len(x), dtype=torch.bool)
        if self.problem.objective == "reach-avoid":
            result = result | (_form(self._physics.reached_constraints(x), x).high <= 0).all(-1)
        if self.problem.has_avoid_set:
            result = result | (_form(self._physics.avoid_constraints(x), x).high <= 0).any(-1)
        return result

    def _residual(self, boxes: Boxes, w: Polynomials, z: Affine) -> tuple[Affine, Tensor]:
        """L^pi W (N,), and a measure (d, N) of what each coordinate adds to its width."""
        physics, x = self._physics, z[:, 1:]
        u = self.feedback(z[:, 0], x)
        f, sigma = _form(physics.drift(x, u), x), physics.diffusion(x, u)
        residual = -w.derivative(0).enclosure()
        weights = torch.zeros(z.shape[-1], len(boxes), dtype=torch.float64)
        for i in range(self.problem.states.dim):
            first = w.derivative(1 + i)
            slope = first.enclosure()
            residual = residual + f[:, i] * slope
            weights = weights + f[:, i].slopes.abs() * slope.magnitude
            for j in range(i, self.problem.states.dim):
                covariance = _product(sigma, i, j)
                if covariance is not None:
                    factor = 0.5 if i == j else 1.0
                    residual = residual + first.derivative(1 + j).enclosure() * covariance * factor
        return residual, weights + residual.slopes.abs()

    def start(self, boxes: Boxes) -> tuple[Tensor, Tensor]:
        """Whether W at tau = 0 is at most the payoff on boxes whose first coordinate is 0."""
        value, x = self._value(boxes), boxes.coordinates()[:, 1:]
        most = 1.0 if self.problem.objective == "invariance" else 0.0
        inside = self._elsewhere(x) if most == 0 else torch.zeros(len(boxes), dtype=torch.bool)
        return (value.high <= most) | inside, _widest(value)

    def side(self, boxes: Boxes, axis: int, outward: int) -> tuple[Tensor, Tensor]:
        """Whether W <= 0 on boxes in a side of D, or they lie in A or B, or no path comes to them from inside."""
        value, z = self._value(boxes), boxes.coordinates()
        x = z[:, 1:]
        u = self.feedback(z[:, 0], x)
        f, sigma = _form(self._physics.drift(x, u), x), self._physics.diffusion(x, u)
        inward = (f[:, axis] * -float(outward)).low > 0
        still = _product(sigma, axis, axis) is None
        unreached = inward if still else torch.zeros_like(inward)
        return (value.high <= 0) | self._elsewhere(x) | unreached, _widest(value)

    def face(self, boxes: Boxes, constraints: Callable, number: int, most: float) -> tuple[Tensor, Tensor]:
        """Whether W <= most at those points of boxes at which a constraint is 0."""
        level = constraints(boxes.coordinates()[:, 1:])[:, number]
        none, part = _zeros(boxes, level)
        value = self._value(part)
        return none | (value.high <= most), _widest(value)

    def _value(self, boxes: Boxes) -> Affine:
        return self.spline.on(boxes).enclosure() - self.margin


def _zeros(boxes: Boxes, level: Affine) -> tuple[Tensor, Boxes]:
    """Whether a level (N,) is not 0 on boxes, and the parts of the boxes that contain all its zeros."""
    spread = level.spread + 1e-14 * level.magnitude
    none = level.centre.abs() > spread
    low, high = [], []
    for slope in level.slopes:
        # |centre + slope e| <= the spread of all other terms.
        others = (spread - slope.abs()).clamp(min=0)
        safe = torch.where(slope.abs() > 1e-300, slope, torch.ones_like(slope))
        middle, reach = -level.centre / safe, others / safe.abs()
        wide = slope.abs() <= 1e-300
        low.append(torch.where(wide, -1.0, (middle - reach - 1e-12)).clamp(-1, 1))
        high.append(torch.where(wide, 1.0, (middle + reach + 1e-12)).clamp(-1, 1))
    return none, boxes.part(torch.stack(low, -1), torch.stack(high, -1))


def _widest(value: Affine) -> Tensor:
    return value.slopes.abs().argmax(0)


def _form(value: Affine | Tensor, like: Affine) -> Affine:
    return value if isinstance(value, Affine) else Affine.of_constant(value, like)


def _product(sigma: Affine | Tensor, i: int, j: int) -> Affine | Tensor | None:
    """The entry (N,) of sigma sigma^T; None where it is 0 in all boxes."""
    rows = sigma[:, i], sigma[:, j]
    if isinstance(sigma, Tensor):
        product = (rows[0] * rows[1]).sum(-1)
        return product if bool(product.any()) else None
    return (rows[0] * rows[1]).sum(-1)
