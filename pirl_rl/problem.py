"""The problem: a controlled SDE, a target set A, an avoid set B and a horizon T.

    dX = f(X, U) dt + sigma(X, U) dW,   X in R^n, U in a box of R^m, W in R^w      Eq. (sde)

V(tau, x) is the largest probability to reach A before B within the time to go tau, Eq. (exit_value). Quantities are in
SI units, or in any others that fit together: where a docstring or a message says s, it means the unit of the horizon.
States x have shape (*, n), controls u (*, m), times to go tau and levels (*). This is the only place where
the physics is written down; networks, environments and integration are elsewhere.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import ClassVar, Literal

import torch
from torch import Tensor

from pirl_rl.errors import ProblemError
from pirl_rl.payoffs import Indicator, Payoff
from pirl_rl.sets import Box, Plane, in_units, units_of_levels

RANDOM_STATES, WIDER = 100_000, 1.5
"""The number of random states at which A and B are compared, and by which factor their box is wider than `states`."""


class ReachAvoidProblem(ABC):
    """The base class of problems.

    A subclass defines `horizon`, `states`, `controls`, `drift`, `diffusion`, and `target_level` or
    `target_constraints`; an invariance problem needs no target. States in both A and B count as failures.

    Args:
        payoff: replaces the payoff of the class.
        horizon: replaces the horizon of the class, in s.

    Attributes:
        horizon: T > 0, in s.
        states: the box of states for sampling and scaling. Nothing is clipped, absorbed or imposed at its edge. An
            angle is a periodic axis of it, `Box(low, high, periodic=[axis])`. The methods of a problem are called with
            periodic coordinates in [low, high), and their results must agree at both ends of the period.
        controls: the box of admissible controls. The entry `action` of a TensorDict is the control in the coordinates
            in which this box is [-1, 1]^m.
        objective: "reach-avoid", or "invariance", where only B absorbs and V(0, x) = 1 outside B.
        payoff: the indicator of A or a smoothing of it.
        state_names: names of the coordinates of the state with their units, such as "v_x (m/s)", for figures and the
            report; without them they are x_1, x_2 and so on.
        control_names: the same for the control; without them they are u_1, u_2 and so on.
    """

    horizon: float
    states: Box
    controls: Box
    state_names: Sequence[str] = ()
    control_names: Sequence[str] = ()
    objective: ClassVar[Literal["reach-avoid", "invariance"]] = "reach-avoid"
    payoff: Payoff = Indicator()

    def __init__(self, payoff: Payoff | None = None, horizon: float | None = None):
        if payoff is not None:
            self.payoff = payoff
        if horizon is not None:
            self.horizon = float(horizon)

    @abstractmethod
    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        """f(x, u) (*, n), in units of the state per s, at states (*, n) and controls (*, m)."""

    @abstractmethod
    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        """sigma(x, u) (*, n, w), in units of the state per sqrt(s), with one column for each noise channel.

        A channel that acts on several states has several entries in its column. Where each state has noise of its own,
        of the strengths s (*, n), this is `torch.diag_embed(s)`.
        """

    def target_level(self, x: Tensor) -> Tensor:
        """The level (*) of A at states (*, n), <= 0 inside. A subclass defines this or `target_constraints`.

        At a face a level changes in proportion to the distance, since its slope gives the probability of a crossing.
        """
        return self.target_constraints(x).amax(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        """Smooth levels (*, k) at states (*, n). Their intersection is A, which may thus have corners.

        Each level may have a unit of its own. For two targets `target_level` is the `torch.minimum` of their levels.

        Raises:
            ProblemError: the problem defines no target.
        """
        if type(self).target_level is ReachAvoidProblem.target_level:
            raise ProblemError(f"{type(self).__name__} needs target_level(x), <= 0 inside the target, got none")
        return self.target_level(x).unsqueeze(-1)

    def avoid_level(self, x: Tensor) -> Tensor:
        """The level (*) of B at states (*, n), <= 0 inside; without it and `avoid_constraints`, B is empty."""
        return self.avoid_constraints(x).amin(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        """Smooth levels (*, k) at states (*, n), each in a unit of its own if wanted. Their union is B."""
        if type(self).avoid_level is ReachAvoidProblem.avoid_level:
            return x.new_full((*x.shape[:-1], 1), torch.inf)
        return self.avoid_level(x).unsqueeze(-1)

    def unreachable(self, x: Tensor) -> Tensor:
        """Which of the states (*, n) outside A and B are known to have V = 0 for every tau, (*) bool."""
        return torch.zeros(x.shape[:-1], dtype=torch.bool, device=x.device)

    def faces(self, count: int, rng: torch.Generator | None = None) -> tuple[Tensor, Tensor] | None:
        """Points on the faces of A and B, for sets that neither sampling nor descent finds.

        Args:
            count: the number of points.
            rng: the random generator to draw from.

        Returns:
            Points (count, n) and the value V (count,) there, or None, and then the points are found by sampling,
            descent and bisection of the level functions.
        """
        return None

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor | None:
        """V (*) at times to go (*) and states (*, n), or None if no closed form is known."""
        return None

    def optimal_control(self, tau: Tensor, x: Tensor) -> Tensor | None:
        """An optimal control (*, m) at times to go (*) and states (*, n), or None if none is known."""
        return None

    @property
    def planes(self) -> Mapping[str, Plane]:
        """Sections of the state space for figures, by name; without them, figures show planes of coordinates."""
        return {}

    # The methods below follow from the sets and the payoff; a subclass has no need to redefine them.

    @property
    def has_avoid_set(self) -> bool:
        """Whether the problem defines a set B."""
        kind, base = type(self), ReachAvoidProblem
        return kind.avoid_level is not base.avoid_level or kind.avoid_constraints is not base.avoid_constraints

    def random_states(self) -> Tensor:
        """The same 100,000 states in each call (100,000, n), in a box 1.5 times as wide as that of the states."""
        rng = torch.Generator().manual_seed(0)
        return self.states.expand(WIDER).sample(RANDOM_STATES, rng, torch.float64)

    def overlap(self) -> Tensor:
        """Those of the random states that lie in both A and B (k, n)."""
        x = self.random_states()
        return x[(self.target_level(x) <= 0) & self.failed(x)]

    @cached_property
    def shared_constraints(self) -> list[int]:
        """The numbers of the constraints of B that hold at some states of A, see `overlap`."""
        if self.objective == "invariance" or not self.has_avoid_set:
            return []
        return (self.avoid_constraints(self.overlap()) <= 0).any(0).nonzero().flatten().tolist()

    def free_target_constraints(self, x: Tensor) -> Tensor:
        """Levels (*, k), at states (*, n), whose intersection is A without B: a state in both sets is a failure.

        The theory has disjoint sets. Where A and B overlap, the constraints of B that A meets are added with the
        opposite sign.
        """
        levels = self.target_constraints(x)
        if not self.shared_constraints:
            return levels
        return torch.cat([levels, -self.avoid_constraints(x)[..., self.shared_constraints]], -1)

    def reached_constraints(self, x: Tensor) -> Tensor:
        """Levels (*, k), at states (*, n), of the set that absorbs with success: A, or A_eps of a smoothed payoff.

        It has no states of B, see `free_target_constraints`.
        """
        if self.payoff.epsilon == 0:
            return self.free_target_constraints(x)
        return _normalized(self.free_target_constraints, x) + self.payoff.epsilon

    def scaled_reached_constraints(self, x: Tensor) -> Tensor:
        """`reached_constraints` (*, k), each divided by a power of two.

        With it single precision has the squares of the levels, and the levels vary about as much as one another, so
        that they can be compared. The powers are 1 where levels have a usual size and are alike.
        """
        return in_units(self.reached_constraints(x), self._reached_units)

    def scaled_reached_level(self, x: Tensor) -> Tensor:
        """The level (*) of the set that absorbs with success, in the same units."""
        return self.scaled_reached_constraints(x).amax(-1)

    def scaled_avoid_constraints(self, x: Tensor) -> Tensor:
        """`avoid_constraints` (*, k), each divided by a power of two, see `scaled_reached_constraints`."""
        return in_units(self.avoid_constraints(x), self._avoid_units)

    def scaled_avoid_level(self, x: Tensor) -> Tensor:
        """`avoid_level` (*) in the same units."""
        return self.scaled_avoid_constraints(x).amin(-1) if self._avoid_units else self.avoid_level(x)

    @cached_property
    def _reached_units(self) -> list[float]:
        return units_of_levels(self.reached_constraints, self.states)

    @cached_property
    def _avoid_units(self) -> list[float]:
        return units_of_levels(self.avoid_constraints, self.states)

    def reached(self, x: Tensor) -> Tensor:
        """Whether states (*, n) are absorbed with success, (*) bool; never in an invariance problem."""
        if self.objective == "invariance":
            return torch.zeros(x.shape[:-1], dtype=torch.bool, device=x.device)
        return (self.reached_constraints(x) <= 0).all(-1)

    def failed(self, x: Tensor) -> Tensor:
        """Whether states (*, n) are inside B, (*) bool: in one of its constraints, also where others have no number."""
        if type(self).avoid_level is ReachAvoidProblem.avoid_level:
            return (self.avoid_constraints(x) <= 0).any(-1)
        return self.avoid_level(x) <= 0

    def interior(self, x: Tensor) -> Tensor:
        """Whether states (*, n) are outside both absorbing sets, where Eq. (hjb_pde) holds, (*) bool."""
        return ~(self.reached(x) | self.failed(x))

    def boundary_value(self, x: Tensor) -> Tensor:
        """V (*) at states (*, n) of the boundary, Eq. (parabolic_boundary): l_eps at tau = 0 and in A_eps, 0 in B.

        In an invariance problem it is 1 outside B.
        """
        alive = (~self.failed(x)).to(x.dtype)
        if self.objective == "invariance":
            return alive
        if self.payoff.epsilon == 0:
            return alive * self.payoff(self.target_level(x))
        return alive * self.payoff(_normalized(self.free_target_constraints, x).amax(-1))


def closed_form(problem: ReachAvoidProblem, tau: Tensor, x: Tensor) -> Tensor | None:
    """V (*) by `exact_value`, which is about the indicator; None where it is not known, and for a smoothed payoff."""
    return problem.exact_value(tau, x) if problem.payoff.epsilon == 0 else None


def with_indicator(problem: ReachAvoidProblem) -> ReachAvoidProblem:
    """A copy of the problem whose payoff is the indicator, so that to come to A itself is a success."""
    hard = copy.copy(problem)
    hard.payoff = Indicator()
    vars(hard).pop("_reached_units", None)  # they belong to the set of the payoff
    return hard


def _normalized(levels, x: Tensor) -> Tensor:
    """g/|grad g| (*, k) of each of the k levels: the signed distance to the surface g = 0, to first order."""
    value, pullback = torch.func.vjp(levels, x)  # type: ignore[misc]
    axes = torch.eye(value.shape[-1], dtype=value.dtype, device=value.device)
    gradients = torch.stack([pullback(one.expand_as(value))[0] for one in axes], -2)
    slope = gradients.norm(dim=-1)
    return value / torch.where(slope > 0, slope, torch.ones_like(slope))
