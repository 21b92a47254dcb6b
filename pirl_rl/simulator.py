"""Simulation of the SDE, Eq. (sde), over one control step, with exits into A and B.

A control is held for dt. The SDE is integrated with sub-steps of length h = dt / substeps:

    x + f h + sigma(x, u) sqrt(h) xi,   xi normal.                                        Eq. (sub_step)

The rule `crossing` names the drift f of a sub-step, and how an exit within it is detected:

- "endpoint": f = f(x, u) at its start, the Euler-Maruyama scheme, and an exit is detected only at its end.
- "bridge": f is the mean of f(x, u) and of f(x', u) at the end x' of the Euler-Maruyama step with the same noise. Where
  sigma is constant the scheme has weak order two (P. E. Kloeden and E. Platen, Numerical Solution of Stochastic
  Differential Equations, section 15.1), and it gives no energy to oscillations. Between its ends the path is a Brownian
  bridge, which may cross faces, see `pirl_rl.crossings`.

A path that both reaches A and enters B within one sub-step counts as a failure. So does a path that leaves for
infinity, because its drift grows too fast, or whose state has no number. Periodic coordinates are brought back into
their period at the end of each sub-step, before levels are taken there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from pirl_rl.clock import Clock
from pirl_rl.compilation import Compiled
from pirl_rl.crossings import crosses_any, enters_intersection
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sigma import constant_matrix, times
from pirl_rl.structure import has_controlled_noise, noise_channels

Crossing = Literal["bridge", "endpoint"]
"""The rule for the drift of a sub-step and for exits within it."""

Draws = tuple[Tensor, Tensor | None, Tensor | None, Tensor | None]
"""The random numbers of a sub-step: normal (w, N) for the noise, and for crossings uniform (R, N, k) for R attempts at
the k faces of A, normal (R, 2, N, k) if there are at least two faces, and uniform (N, k') for the k' faces of B."""

ATTEMPTS = 2
"""How often a path may cross the last face of a target with corners in a sub-step, see `enters_intersection`."""

LOST = 1e4
"""The distance from the center of the box of states, in half widths, beyond which a path counts as lost."""


class Step(NamedTuple):
    """The outcome of a control step.

    Attributes:
        state: states after the step (N, n); a path that ended keeps the state of the sub-step in which it ended.
        reached: paths that reached A (N,) bool.
        failed: paths that entered B or were lost (N,) bool; none of them counts as reached.
        noise: the sum of sigma dW over the sub-steps (N, n) until the path ended, in the units of the state. Its mean
            given the state before the step is zero, except for paths that are lost, as it stops at a stopping time.
    """

    state: Tensor
    reached: Tensor
    failed: Tensor
    noise: Tensor


def exit_value(problem: ReachAvoidProblem, step: Step) -> Tensor:
    """The payoff (N,) of paths that end with this step: 1 if they reached A, 0 if they failed, else l_eps."""
    payoff = torch.where(step.reached, torch.ones_like(step.state[..., 0]), problem.boundary_value(step.state))
    return torch.where(step.failed, torch.zeros_like(payoff), payoff)


def midpoint_drift(problem: ReachAvoidProblem, x: Tensor, u: Tensor, drift: Tensor, h: Tensor | float) -> Tensor:
    """f(x + f(x, u) h/2, u) (N, n), the drift at the middle of a step of the length h without noise.

    See `drift_after` for a middle at which the physics is undefined.

    Args:
        problem: the physics.
        x: states (N, n).
        u: physical controls (N, m).
        drift: f(x, u) (N, n).
        h: the length of the step in s, which broadcasts with (N, n).
    """
    return drift_after(problem, x, u, drift, drift * (h / 2))


def drift_after(problem: ReachAvoidProblem, x: Tensor, u: Tensor, drift: Tensor, move: Tensor) -> Tensor:
    """f(x + move, u) (N, n), and f(x, u) where x + move is a state at which the physics is undefined, as inside a set.

    Args:
        problem: the physics.
        x: states (N, n).
        u: physical controls (N, m).
        drift: f(x, u) (N, n).
        move: how far the states move (N, n), in their units.
    """
    moved = problem.states.wrap(x + move)
    # Where the drift has no number `moved` has none, and there a drift may well have one again: the sum has none.
    if torch.is_grad_enabled():
        with torch.no_grad():
            defined = (problem.drift(moved, u) + drift).isfinite().all(-1, keepdim=True)
        return problem.drift(torch.where(defined, moved, x), u)
    after = problem.drift(moved, u)
    return torch.where((after + drift).isfinite(), after, drift)


@dataclass(frozen=True)
class Simulator:
    """Integrates a problem over one control step.

    Attributes:
        shared: the compiled simulator that functions which play many paths take in place of this one, see `share`;
            None if there is none.

    Args:
        problem: the physics.
        dt: the length of a control step, in s.
        substeps: the number of integration steps in a control step.
        crossing: "bridge" or "endpoint", the rule for the drift of a sub-step and for exits within it.
        compile: whether a sub-step is compiled, for one fixed number N of paths; the random numbers stay the same. None
            leaves the choice to functions that know how many steps they play.

    Raises:
        ArgumentError: `dt` is not in (0, horizon], `substeps` is below 1, or `crossing` is unknown.
    """

    problem: ReachAvoidProblem
    dt: float = 0.1
    substeps: int = 1
    crossing: Crossing = "bridge"
    compile: bool | None = None
    shared: Simulator | None = field(default=None, init=False, compare=False, repr=False)

    def __post_init__(self):
        if not (isinstance(self.dt, Real) and 0 < self.dt <= self.problem.horizon):
            raise ArgumentError(f"dt: expected 0 < dt <= horizon = {self.problem.horizon}, got {self.dt!r}")
        if not (isinstance(self.substeps, int) and self.substeps >= 1):
            raise ArgumentError(f"substeps: expected an integer >= 1, got {self.substeps!r}")
        if self.crossing not in ("bridge", "endpoint"):
            raise ArgumentError(f"crossing: expected 'bridge' or 'endpoint', got {self.crossing!r}")

    @cached_property
    def clock(self) -> Clock:
        """Counts the control steps of the problem's horizon."""
        return Clock(self.dt, self.problem.horizon)

    @cached_property
    def compiled(self) -> Simulator:
        """The same simulator with compiled sub-steps, which are compiled once however often it is asked for."""
        return replace(self, compile=True)

    def share(self, compiled: Simulator) -> None:
        """Let functions that play many paths take another simulator, which equals `self.compiled`.

        Functions that take single steps go on with this one, since each number of paths would be compiled by itself.
        """
        object.__setattr__(self, "shared", compiled)

    @cached_property
    def channels(self) -> int:
        """The number w of noise channels."""
        return noise_channels(self.problem)

    @cached_property
    def controlled_noise(self) -> bool:
        """Whether sigma depends on the control."""
        return has_controlled_noise(self.problem)

    def constant_sigma(self, device: torch.device) -> Tensor | None:
        """sigma (n, w) on a device if it depends on neither state nor control, else None."""
        if self._found_sigma is None:
            return None
        # A copy to a GPU takes time, and a recording of its kernels must not contain one.
        if device not in self._sigma_on:
            self._sigma_on[device] = self._found_sigma.to(device)
        return self._sigma_on[device]

    @cached_property
    def _sigma_on(self) -> dict[torch.device, Tensor]:
        return {}

    @cached_property
    def _found_sigma(self) -> Tensor | None:
        rng = torch.Generator().manual_seed(0)
        x, u = (box.sample(256, rng, torch.float64) for box in (self.problem.states, self.problem.controls))
        return constant_matrix(self.problem.diffusion, x, u)

    def sigma(self, x: Tensor, u: Tensor, constant: Tensor | None) -> Tensor:
        """sigma (N, n, w) at x (N, n) and u (N, m); compiled code cannot find `constant_sigma`, and is given it."""
        if constant is None:
            return self.problem.diffusion(x, u)
        return constant.to(x).expand(*x.shape, constant.shape[-1])

    @cached_property
    def _advanced(self) -> Callable[..., tuple[Tensor, Tensor, Tensor, Tensor]]:
        return Compiled(self._advance, "the simulator") if self.compile else self._advance

    @torch.no_grad()
    def step(
        self,
        x: Tensor,
        u: Tensor,
        rng: torch.Generator | None = None,
        dt: Tensor | None = None,
        crossings: bool = True,
    ) -> Step:
        """Advance paths that are outside A and B by one control step.

        Args:
            x: states (N, n).
            u: physical controls (N, m), held over the step.
            rng: the random generator of the noise and of the crossings.
            dt: the length of the step for each path (N,), in s; default `self.dt` for all.
            crossings: whether exits are seen between the ends of a sub-step too, where the rule is "bridge". They take
                most of the time of a step that is not compiled.
        """
        # Each coordinate is made contiguous in memory, because problems unbind states into coordinates. It is always a
        # copy, since the compiler cannot differentiate along a part of a larger tensor.
        x = x.mT.clone(memory_format=torch.contiguous_format).mT
        h = (x.new_tensor(self.dt) if dt is None else dt) / self.substeps
        self.problem.states.center_and_half_width(x)  # which compiled code would note, and be compiled again
        reached = torch.zeros(x.shape[:-1], dtype=torch.bool, device=x.device)
        failed, noise = reached, x
        for index in range(self.substeps):
            random = self._draw(x, rng, crossings)
            moved, kick, now_reached, now_failed = self._advanced(x, u, h, *random, self.constant_sigma(x.device))
            if index == 0:
                x, reached, failed, noise = moved, now_reached & ~now_failed, now_failed, kick
                continue
            active = ~(reached | failed)
            x, noise = (torch.where(active.unsqueeze(-1), *pair) for pair in ((moved, x), (noise + kick, noise)))
            failed = failed | (active & now_failed)
            reached = reached | (active & now_reached & ~now_failed)
        return Step(x, reached, failed, noise)

    def flow(self, x: Tensor, u: Tensor, dt: Tensor | None = None) -> Tensor:
        """States (N, n) after a control step without noise and exits; differentiable in x (N, n) and u (N, m).

        Args:
            x: states (N, n).
            u: physical controls (N, m).
            dt: the length of the step for each state (N,), in s; default `self.dt` for all.
        """
        h = self.dt / self.substeps if dt is None else (dt / self.substeps).to(x)[..., None]
        for _ in range(self.substeps):
            x = self.problem.states.wrap(x + self._drift(x, u, h) * h)
        return x

    def _drift(self, x: Tensor, u: Tensor, h: Tensor | float, kick: Tensor | float = 0.0) -> Tensor:
        """The drift f (N, n) of Eq. (sub_step) for sigma dW = kick (N, n); the length h broadcasts with (N, n)."""
        drift = self.problem.drift(x, u)
        if self.crossing == "endpoint":
            return drift
        return (drift + drift_after(self.problem, x, u, drift, drift * h + kick)) / 2

    def _draw(self, x: Tensor, rng: torch.Generator | None, crossings: bool) -> Draws:
        """The random numbers of a sub-step.

        They are drawn here, so that `_advance` is a function without side effects, which can be compiled.
        """
        kind = {"generator": rng, "dtype": x.dtype, "device": x.device}
        noise = torch.randn((self.channels, *x.shape[:-1]), **kind)
        counts = self._crossings  # outside of compiled code in any case
        of_target, of_avoid = counts if crossings else (0, 0)
        attempts, faces = ATTEMPTS if of_target > 1 else 1, (*x.shape[:-1], of_target)
        target = torch.rand((attempts, *faces), **kind) if of_target else None
        avoid = torch.rand((*x.shape[:-1], of_avoid), **kind) if of_avoid else None
        corners = torch.randn((attempts, 2, *faces), **kind) if of_target > 1 else None
        return noise, target, corners, avoid

    @cached_property
    def _crossings(self) -> tuple[int, int]:
        """The numbers of constraints of A and of B whose crossings are drawn."""
        problem = self.problem
        x = problem.states.sample(2, torch.Generator().manual_seed(0))
        # Also without a bridge: the problem looks for an overlap of its sets and for units of their levels. In compiled
        # code it must not.
        target = problem.scaled_reached_constraints(x).shape[-1] if problem.objective == "reach-avoid" else 0
        avoid = problem.scaled_avoid_constraints(x).shape[-1] if problem.has_avoid_set else 0
        return (target, avoid) if self.crossing == "bridge" else (0, 0)

    def _advance(
        self,
        x: Tensor,
        u: Tensor,
        h: Tensor,
        noise: Tensor,
        target: Tensor | None,
        corners: Tensor | None,
        avoid: Tensor | None,
        constant: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """One sub-step: states (N, n), sigma dW (N, n), and whether paths are in A and in B or crossed a face."""
        problem, sigma = self.problem, self.sigma(x, u, constant)
        kick = times(sigma, (noise * h.sqrt()).mT)
        moved = problem.states.wrap(x + self._drift(x, u, h[..., None], kick) * h[..., None] + kick)
        lost = ~(problem.states.normalize(moved).abs() <= LOST).all(-1)
        moved, kick = (torch.where(lost.unsqueeze(-1), *pair) for pair in ((x, moved), (torch.zeros_like(kick), kick)))
        reached, failed = problem.reached(moved), problem.failed(moved) | lost
        path, within = (x, moved, sigma, h), problem.states.within_period
        if target is not None:
            reached = reached | enters_intersection(within(problem.scaled_reached_constraints), *path, target, corners)
        if avoid is not None:
            failed = failed | crosses_any(within(problem.scaled_avoid_constraints), *path, avoid)
        return moved, kick, reached, failed
