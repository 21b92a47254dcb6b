"""The filter that changes a control as little as possible, so that V does not fall in expectation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.solution import Solution
from pirl_rl.structure import is_control_affine


@dataclass(frozen=True)
class SmallestChange:
    """The control next to the nominal one, in normalised controls, under which L^u V >= 0, Eq. (parabolic_operator).

    Under this condition V(tau, X) is a submartingale, so that a path succeeds with probability V or more if V and its
    derivatives are exact. It is the filter of control barrier functions (A. D. Ames, X. Xu, J. W. Grizzle and P.
    Tabuada, IEEE Transactions on Automatic Control 62, 2017) with V as the barrier function and without a decay. Where
    no control meets it, the one with the largest L^u V is taken. Since the exact V has sup_u L^u V = 0, Eq. (hjb_pde),
    it leaves no freedom where V depends on the control. Its promise rests on the derivatives of V, whose errors it
    follows along the edge of the condition; `Submartingale` needs the values of V alone.

    Args:
        solution: the learned value.

    Raises:
        ArgumentError: the drift is not affine in u, sigma depends on u, or V has no second derivatives.
    """

    solution: Solution

    def __post_init__(self):
        problem = self.solution.problem
        if not isinstance(self.solution, Solution):
            raise ArgumentError(
                "mode: expected a value with second derivatives for 'smallest_change', got a "
                f"{type(self.solution).__name__}; the other modes need none"
            )
        if not is_control_affine(problem):
            raise ArgumentError(
                f"mode: expected a drift that is affine in u and a sigma without u for 'smallest_change', got those of "
                f"{type(problem).__name__}; the other modes take any problem"
            )

    def __call__(self, tau: Tensor, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The control (N, m) in place of u (N, m), and where it is another (N,), all in SI units like tau and x."""
        controls, m = self.solution.problem.controls, u.shape[-1]
        # L^u V is affine in u: the middle of the box and a step along each of its axes have all of it.
        marks = torch.cat([torch.zeros(1, m), torch.eye(m)]).to(u).unsqueeze(1).expand(m + 1, len(u), m)
        rates = self.solution.residual(
            tau.repeat(m + 1), x.repeat(m + 1, 1), controls.denormalize(marks).flatten(0, 1)
        ).reshape(m + 1, len(u))
        action, refused = nearest_action(controls.normalize(u), rates[0], (rates[1:] - rates[0]).mT)
        return torch.where(refused.unsqueeze(-1), controls.denormalize(action), u), refused


def nearest_action(action: Tensor, offset: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    """The point b of [-1, 1]^m next to an action a with c + g . b >= 0, or the one with the largest c + g . b.

    By the conditions of Karush, Kuhn and Tucker, b = clip(a + lambda g, -1, 1) with the smallest multiplier lambda >= 0
    for which the constraint holds. Along this path c + g . b never falls. Both are linear between the lambda at which a
    coordinate arrives at a bound, so that the first of these with c + g . b >= 0 and the one before it enclose the
    solution. It is exact, takes m + 1 evaluations and serves all N states at once.

    Args:
        action: a (N, m) in [-1, 1].
        offset: c (N,).
        slope: g (N, m).

    Returns:
        The point (N, m), and where it differs from a (N,) bool.
    """
    still = slope == 0
    bound = torch.where(still, action, slope.sign())
    arrivals = torch.where(still, torch.zeros_like(slope), (bound - action) / slope).sort(-1).values
    multiplier = torch.nn.functional.pad(arrivals, (1, 0)).mT.unsqueeze(-1)
    path = torch.where(still, action, (action + multiplier * slope).clamp(-1, 1))
    # Rounding must not leave the end of the path short of its bounds.
    path = torch.cat([action.unsqueeze(0), path[1:-1], bound.unsqueeze(0)])
    rate = offset + (path * slope).sum(-1)
    met = rate >= 0
    after = torch.where(met.any(0), met.int().argmax(0), len(path) - 1)
    before = (after - 1).clamp(min=0)

    def at(entries: Tensor, index: Tensor) -> Tensor:
        return entries.gather(0, index.reshape(1, -1, *[1] * (entries.ndim - 2)).expand(1, *entries.shape[1:]))[0]

    low, high = at(rate, before), at(rate, after)
    share = torch.where((low < 0) & (high > 0), -low / (high - low), torch.ones_like(low)).unsqueeze(-1)
    nearest = at(path, before) + share * (at(path, after) - at(path, before))
    return nearest.clamp(-1, 1), ~met[0]
