"""Checks of the states, times to go and policies that users hand in."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from numbers import Integral
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box

Policy = Callable[[Tensor, Tensor], Tensor]
"""Maps tau (N,) in s and x (N, n) to the control (N, m), both in SI units."""

ROUNDING = 1e-6
"""The share of the horizon by which tau may exceed it, because of rounding in single precision."""

CONTROL_ROUNDING = 1e-4
"""The share of its range by which a control may exceed its bounds, because of rounding in single precision."""

FAR = 2.0
"""A state is far outside the box of states if it lies outside a box of this many times the widths."""


def checked_points(
    problem: ReachAvoidProblem, tau: Any, x: Any, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Times to go and states as tensors, after a check; states far outside the box of states are warned of.

    Args:
        problem: gives the number of states, their box and the horizon.
        tau: times to go in s, a number or an array that broadcasts to (*).
        x: states (*, n) in SI units.
        dtype, device: of the results.

    Returns:
        The times to go (*) and the states (*, n).

    Raises:
        ArgumentError: a shape, numbers that are not finite, or a time to go outside [0, horizon].
    """
    state = _numbers("x", x, dtype, device)
    dim, horizon = problem.states.dim, problem.horizon
    if state.ndim < 1 or state.shape[-1] != dim:
        raise ArgumentError(f"x: expected states of shape (*, {dim}), got {tuple(state.shape)}")
    if not bool(state.isfinite().all()):
        raise ArgumentError("x: expected finite states, got NaN or infinite ones")
    times, shape = _numbers("tau", tau, dtype, device), state.shape[:-1]
    try:
        times = times.expand(shape)
    except RuntimeError:
        message = f"tau: expected a number or the shape {tuple(shape)} of the states, got {tuple(times.shape)}"
        raise ArgumentError(message) from None
    if not bool(((times >= 0) & (times <= horizon * (1 + ROUNDING))).all()):
        raise ArgumentError(f"tau: expected 0 <= tau <= horizon = {horizon} s, got {tau}")
    if not bool(_far_box(problem.states).contains(state).all()):
        # The text has no numbers of these states, so that Python shows it once and not at each step of a simulation.
        message = f"x: some states lie far outside the box of states {problem.states}; nothing is learned there"
        warnings.warn(message, stacklevel=3)
    return times, state


@cache
def _far_box(states: Box) -> Box:
    """The box outside which a state is far; making it for every call would take longer than the rest of the check."""
    return states.expand(FAR)


def points_and_answer(
    problem: ReachAvoidProblem, tau: Any, x: Any, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Callable[[Tensor], Any]]:
    """The results of `checked_points`, and a function that converts results to the kind of x, numpy or torch."""
    times, state = checked_points(problem, tau, x, dtype, device)
    if isinstance(x, Tensor):
        return times, state, lambda answer: answer.to(x.device)
    return times, state, lambda answer: np.asarray(answer.cpu())


def checked_policy(policy: Policy, problem: ReachAvoidProblem, name: str = "policy") -> Policy:
    """The policy, whose controls are checked at every call.

    The function that is returned raises an ArgumentError where the controls have another shape than (N, m), are not
    finite, or lie outside `problem.controls`; it starts with `name`.

    Raises:
        ArgumentError: the policy is no function.
    """
    if not callable(policy):
        raise ArgumentError(f"{name}: expected a function of tau and x, got {policy!r}")
    allowed = problem.controls.expand(1 + CONTROL_ROUNDING)

    def checked(tau: Tensor, x: Tensor) -> Tensor:
        control = policy(tau, x)
        if not isinstance(control, Tensor):
            raise ArgumentError(f"{name}: expected controls as a tensor, got {type(control).__name__}")
        expected = (len(x), problem.controls.dim)
        if control.shape != expected:
            raise ArgumentError(
                f"{name}: expected controls of shape {expected} for {len(x)} states, got {tuple(control.shape)}"
            )
        bad = ~(control.isfinite().all(-1) & allowed.contains(control))
        if bool(bad.any()):
            first = int(bad.nonzero()[0])
            raise ArgumentError(
                f"{name}: expected controls in {problem.controls}, got {control[first].tolist()} at "
                f"tau = {tau[first].item()} s, x = {x[first].tolist()}"
            )
        return control

    return checked


def check_integer(name: str, value: int, least: int) -> None:
    """Refuse what is no integer, or one that is too small.

    Raises:
        ArgumentError: with the name of the argument.
    """
    if isinstance(value, bool) or not (isinstance(value, int) and value >= least):
        raise ArgumentError(f"{name}: expected an integer >= {least}, got {value!r}")


def seeded(seed: int, device: torch.device) -> torch.Generator:
    """A random generator with a seed.

    Raises:
        ArgumentError: the seed is no integer.
    """
    if not isinstance(seed, Integral):
        raise ArgumentError(f"seed: expected an integer, got {seed!r}")
    return torch.Generator(device).manual_seed(int(seed))


def _numbers(name: str, given: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    # Of a complex array torch would take the real part.
    if isinstance(given, (Tensor, np.ndarray)) and "complex" in str(given.dtype):
        raise ArgumentError(f"{name}: expected real numbers, got complex ones")
    try:
        return torch.as_tensor(given, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ArgumentError(f"{name}: expected numbers, got {type(given).__name__}: {error}") from None
