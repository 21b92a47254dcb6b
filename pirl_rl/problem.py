"""The problem: a controlled SDE, a target set, an avoid set and a horizon. The one copy of the physics.

    dX = f(X, U) dt + sigma(X, U) dW,   X in R^n, U in a box of R^m, W in R^w,

V(tau, x) is the largest probability to reach the target A before the avoid set B within the time to go tau. SI units;
x has shape (*, n), u (*, m), tau and levels (*). Nothing here knows of networks, environments or integration.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from pirl_rl.errors import ProblemError
from pirl_rl.payoffs import Indicator, Payoff
from pirl_rl.sets import Box, Plane


class ReachAvoidProblem(ABC):
    """Base class. A problem gives `horizon`, `states`, `controls`, `drift`, `diffusion` and `target_level`.

    Attributes:
        horizon: T > 0 in seconds.
        states: box for sampling and scaling; nothing is clipped, absorbed or imposed at its edge.
        controls: box of admissible controls; `action` in a TensorDict is its [-1, 1] coordinate.
        objective: "reach-avoid", or "invariance": only B absorbs and V(0, x) = 1 outside B.
        payoff: the (smoothed) indicator of the target.
    """

    horizon: float
    states: Box
    controls: Box
    objective: ClassVar[Literal["reach-avoid", "invariance"]] = "reach-avoid"
    payoff: Payoff = Indicator()

    def __init__(self, payoff: Payoff | None = None, horizon: float | None = None):
        if payoff is not None:
            self.payoff = payoff
        if horizon is not None:
            self.horizon = float(horizon)

    @abstractmethod
    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        """f(x, u): (*, n), (*, m) -> (*, n)."""

    @abstractmethod
    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        """sigma(x, u): (*, n), (*, m) -> (*, n, w), one column per noise channel."""

    def target_level(self, x: Tensor) -> Tensor:
        """(*, n) -> (*), <= 0 inside A. Give this or `target_constraints`."""
        return self.target_constraints(x).amax(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        """(*, n) -> (*, k): smooth levels whose intersection is A, for sets with corners."""
        if type(self).target_level is ReachAvoidProblem.target_level:
            raise ProblemError(f"{type(self).__name__} needs target_level(x): <= 0 inside the target")
        return self.target_level(x).unsqueeze(-1)

    def avoid_level(self, x: Tensor) -> Tensor:
        """(*, n) -> (*), <= 0 inside B; B is empty unless this or `avoid_constraints` is given."""
        return self.avoid_constraints(x).amin(-1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        """(*, n) -> (*, k): smooth levels whose union is B."""
        if type(self).avoid_level is ReachAvoidProblem.avoid_level:
            return x.new_full((*x.shape[:-1], 1), torch.inf)
        return self.avoid_level(x).unsqueeze(-1)

    def unreachable(self, x: Tensor) -> Tensor:
        """(*, n) -> (*) bool: states outside A and B from which V = 0 is known."""
        return torch.zeros(x.shape[:-1], dtype=torch.bool, device=x.device)

    def faces(self, count: int, rng: torch.Generator | None = None) -> tuple[Tensor, Tensor] | None:
        """Points (count, n) on the faces of A and B and the value V (count,) there, for sets too thin to be found by
        sampling; None leaves it to bisection on the level functions."""
        return None

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor | None:
        """V(tau, x): (*), (*, n) -> (*), where it is known in closed form."""
        return None

    def optimal_control(self, tau: Tensor, x: Tensor) -> Tensor | None:
        """An optimal u: (*), (*, n) -> (*, m), where it is known."""
        return None

    @property
    def planes(self) -> Mapping[str, Plane]:
        """Sections of the state space to look at, by name; none by default."""
        return {}

    # What the sets and the payoff say together.

    @property
    def has_avoid_set(self) -> bool:
        kind, base = type(self), ReachAvoidProblem
        return kind.avoid_level is not base.avoid_level or kind.avoid_constraints is not base.avoid_constraints

    def reached_constraints(self, x: Tensor) -> Tensor:
        """(*, k) levels of the set that absorbs with success: A, or A_eps with a smoothed payoff."""
        if self.payoff.epsilon == 0:
            return self.target_constraints(x)
        return _normalized(self.target_constraints, x) + self.payoff.epsilon

    def reached(self, x: Tensor) -> Tensor:
        """(*) bool: absorbed with success. Never in an invariance problem, where success is survival."""
        if self.objective == "invariance":
            return torch.zeros(x.shape[:-1], dtype=torch.bool, device=x.device)
        return (self.reached_constraints(x) <= 0).all(-1)

    def failed(self, x: Tensor) -> Tensor:
        """(*) bool: inside B."""
        return self.avoid_level(x) <= 0

    def interior(self, x: Tensor) -> Tensor:
        """(*) bool: outside both absorbing sets, where the HJB equation holds."""
        return ~(self.reached(x) | self.failed(x))

    def boundary_value(self, x: Tensor) -> Tensor:
        """V on the boundary, Eq. (parabolic_boundary): l_eps at tau = 0 and in A_eps, 0 in B; (*, n) -> (*)."""
        alive = (~self.failed(x)).to(x.dtype)
        if self.objective == "invariance":
            return alive
        if self.payoff.epsilon == 0:
            return alive * self.payoff(self.target_level(x))
        return alive * self.payoff(_normalized(self.target_constraints, x).amax(-1))


def has_controlled_noise(problem: ReachAvoidProblem, points: int = 256, seed: int = 0) -> bool:
    """Whether sigma depends on u, found on sampled states and pairs of controls."""
    rng = torch.Generator().manual_seed(seed)
    x = problem.states.sample(points, rng)
    one, other = (problem.diffusion(x, problem.controls.sample(points, rng)) for _ in range(2))
    return not torch.equal(one, other)


def _normalized(levels, x: Tensor) -> Tensor:
    """g/|grad g| for each of the k levels: the signed distance to the surface g = 0, to first order."""
    value, pullback = torch.func.vjp(levels, x)  # type: ignore[misc]
    gradients = torch.stack([pullback(one.expand_as(value))[0] for one in torch.eye(value.shape[-1]).to(value)], -2)
    slope = gradients.norm(dim=-1)
    return value / torch.where(slope > 0, slope, torch.ones_like(slope))


def check_problem(problem: ReachAvoidProblem, points: int = 100_000, seed: int = 0) -> None:
    """Refuse a problem that contradicts itself: wrong shapes, no horizon, or sets that overlap on sampled points.

    Args:
        points: how many points of `states`, widened by half, are tried for the overlap of A and B.

    Raises:
        ProblemError: with the part, what was expected and what was got.
    """
    name = type(problem).__name__
    for attribute in ("horizon", "states", "controls"):
        if not hasattr(problem, attribute):
            raise ProblemError(f"{name} has no {attribute}")
    if not problem.horizon > 0:
        raise ProblemError(f"{name}: horizon must be positive, got {problem.horizon}")
    rng = torch.Generator().manual_seed(seed)
    x = problem.states.expand(1.5).sample(points, rng, dtype=torch.float64)
    u = problem.controls.sample(16, rng, dtype=torch.float64)
    few, n = x[:16], problem.states.dim
    _expect_shape(f"{name}.drift", problem.drift(few, u), (16, n))
    sigma = problem.diffusion(few, u)
    if sigma.ndim != 3:
        raise ProblemError(f"{name}.diffusion: expected shape (*, {n}, w), got {tuple(sigma.shape)} for 16 states")
    _expect_shape(f"{name}.diffusion", sigma, (16, n, sigma.shape[-1]))
    _expect_shape(f"{name}.avoid_level", problem.avoid_level(few), (16,))
    if problem.objective == "reach-avoid":
        _expect_shape(f"{name}.target_level", problem.target_level(few), (16,))
        both = (problem.target_level(x) <= 0) & problem.failed(x)
        if both.any():
            point = [round(value, 6) for value in x[both][0].tolist()]
            raise ProblemError(
                f"{name}: target and avoid set overlap, expected disjoint sets; {int(both.sum())} of {points} "
                f"sampled points lie in both, for example x = {point}"
            )


def _expect_shape(what: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise ProblemError(f"{what}: expected shape {shape} for 16 states, got {tuple(value.shape)}")
