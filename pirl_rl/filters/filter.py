"""A nominal controller that a learned solution protects."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from pirl_rl.arguments import Policy, checked_policy, points_and_answer
from pirl_rl.compilation import Compiled
from pirl_rl.errors import ArgumentError
from pirl_rl.filters.least_restrictive import LeastRestrictive
from pirl_rl.filters.smallest_change import SmallestChange
from pirl_rl.filters.submartingale import Submartingale
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution
from pirl_rl.time_steps import propose_time_steps

Mode = Literal["submartingale", "least_restrictive", "smallest_change"]

Rule = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""Maps tau (N,), x (N, n) and nominal controls (N, m) to controls (N, m) and where they are others (N,)."""

MODES: dict[str, Callable[[Solution, Simulator, float], Rule]] = {
    "submartingale": Submartingale,
    "least_restrictive": LeastRestrictive,
    "smallest_change": lambda solution, simulator, p: SmallestChange(solution),
}
"""The rules of the filter."""


class ReachAvoidFilter:
    """A policy that plays a nominal controller as long as a learned solution does not forbid it.

        filtered = ReachAvoidFilter(run, nominal)
        pirl_rl.monte_carlo(run.problem, filtered, tau, x)

    Args:
        run_or_solution: a run, or its solution.
        nominal: maps tau (N,) in s and x (N, n) to controls (N, m) inside their box, in SI units, all of them tensors.
            It may be left out where only `correct` is called.
        p: the wanted probability of success, in (0, 1); "smallest_change" makes no use of it.
        mode: "submartingale", see `Submartingale`, which bounds success on whole paths; "least_restrictive", see
            `LeastRestrictive`, which bounds it one step ahead; or "smallest_change", see `SmallestChange`.
        simulator: gives the control step; the default is that of the run, and for a solution a proposal of
            `pirl_rl.time_steps`.
        compile: whether calls with a single state are compiled, which takes up to a minute at the first of them. Where
            that fails, they run eagerly after one warning.

    Raises:
        ArgumentError: an argument has no sense, or the mode cannot serve the problem.
    """

    def __init__(
        self,
        run_or_solution: Any,
        nominal: Policy | None = None,
        p: float = 0.9,
        mode: Mode = "submartingale",
        *,
        simulator: Simulator | None = None,
        compile: bool = False,
    ):
        self.solution = getattr(run_or_solution, "solution", run_or_solution)
        if not (hasattr(self.solution, "value") and hasattr(self.solution, "policy")):
            raise ArgumentError(f"run_or_solution: expected a run or a solution, got {run_or_solution!r}")
        if isinstance(p, bool) or not (isinstance(p, (int, float)) and 0 < p < 1):
            raise ArgumentError(f"p: expected a probability between 0 and 1, got {p!r}")
        if mode not in MODES:
            raise ArgumentError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}")
        self.problem, self.compile = self.solution.problem, compile
        self._nominal = None if nominal is None else checked_policy(nominal, self.problem, "nominal")
        self.simulator = simulator or getattr(run_or_solution, "simulator", None) or _proposed(self.problem)
        self.rule = MODES[mode](self.solution, self.simulator, float(p))

    def __call__(self, tau: Any, x: Any) -> Any:
        """The filtered control (*, m) in SI units, for numpy arrays and torch tensors: it is of the kind of x.

        Args:
            tau: times to go in s, a number or (*).
            x: states (*, n) in SI units.

        Raises:
            ArgumentError: there is no nominal controller, or states, times to go or nominal controls make no sense.
        """
        if self._nominal is None:
            raise ArgumentError("nominal: expected a controller, got None; call correct(tau, x, u) for given controls")
        times, state, answer = self._arguments(tau, x)
        flat = times.reshape(-1), state.reshape(-1, state.shape[-1])
        control, _ = self._apply(*flat, self._nominal(*flat))
        return answer(control.reshape(*times.shape, control.shape[-1]))

    def correct(self, tau: Any, x: Any, u: Any) -> tuple[Any, Any]:
        """The controls (*, m) in place of u (*, m), in SI units, and where the filter intervened (*) bool.

        Args:
            tau: times to go in s, a number or (*).
            x: states (*, n) in SI units; the results are of its kind, numpy or torch.
            u: nominal controls (*, m) inside their box, in SI units.

        Raises:
            ArgumentError: states, times to go or controls make no sense.
        """
        times, state, answer = self._arguments(tau, x)
        flat, m = (times.reshape(-1), state.reshape(-1, state.shape[-1])), self.problem.controls.dim
        given = torch.as_tensor(u, dtype=state.dtype, device=state.device).reshape(-1, m)
        control, refused = self._apply(*flat, checked_policy(lambda t, y: given, self.problem, "u")(*flat))
        return answer(control.reshape(*times.shape, m)), answer(refused.reshape(times.shape))

    def _arguments(self, tau: Any, x: Any) -> tuple[Tensor, Tensor, Callable[[Tensor], Any]]:
        return points_and_answer(self.problem, tau, x, self.solution.dtype, self.solution.device)

    @torch.no_grad()
    def _apply(self, tau: Tensor, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        rule = self._compiled if self.compile and len(x) == 1 else self.rule
        return rule(tau, self.problem.states.wrap(x), u.to(x))

    @cached_property
    def _compiled(self) -> Rule:
        return Compiled(self.rule.__call__, "the filter")


def _proposed(problem: ReachAvoidProblem) -> Simulator:
    steps = propose_time_steps(problem)
    return Simulator(problem, steps.dt, steps.substeps)
