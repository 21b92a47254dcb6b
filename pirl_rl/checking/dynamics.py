"""Checks of the dynamics: controls, noise, angles, units of time, and steps."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from pirl_rl.checking.findings import Finding, found
from pirl_rl.checking.samples import Samples
from pirl_rl.rates import across_box
from pirl_rl.simulator import Crossing
from pirl_rl.time_steps import TOLERANCE, propose_time_steps

STILL = 1e-3
"""Moves in the whole horizon, in widths of the box, below which nothing happens."""

TIME_NAMES = {"dt", "delta_t", "deltat", "sqrt_dt", "time_step", "timestep", "step_size"}
"""Names that a function which returns rates has no need of."""

ANGLES = (2 * math.pi, 360.0)
"""Periods of angles, in radians and degrees."""

COVERS, ONE_TURN = 0.9, 1.1
"""The share of a period that a box covers at least if its coordinate is an angle which may go all the way round, and
that it covers at most if it is one turn wide."""

PART = 0.38
"""A shift by this share of its period changes a function that repeats."""

THIN = 1.0
"""A move in one integration step, in depths of a set, from which paths jump over the set.

Of Brownian paths that meet a wall, the simulator lets 0.15 % pass at this ratio, and 2.9 % at twice the ratio.
"""

COARSE = 0.1
"""The distance of two numbers in single precision, in the largest move of an integration step, that is too large."""


def controls(samples: Samples) -> Iterator[Finding]:
    """Each control should change the drift or the noise at some state."""
    problem, (x, u) = samples.problem, samples.outside
    before = _physics(samples, x, u)
    idle = []
    for index in range(u.shape[-1]):
        moved = u.clone()
        moved[:, index] = u[:, index].roll(1)
        if all(torch.equal(one, other) for one, other in zip(before, _physics(samples, x, moved), strict=True)):
            idle.append(index)
    if idle:
        names = "no control changes" if len(idle) == u.shape[-1] else f"the controls {idle} do not change"
        yield found(problem, "warning", "drift", f"{names} the drift or the noise at any of {len(x)} states.")


def noise(samples: Samples) -> Iterator[Finding]:
    """The rank of sigma; without noise V jumps, and a network cannot learn a jump."""
    problem, (x, u) = samples.problem, samples.outside
    width = 2 * problem.states.center_and_half_width(x)[1]
    scaled = problem.diffusion(x, u) / width.unsqueeze(-1)
    rank = torch.linalg.matrix_rank(scaled).double()
    n = x.shape[-1]
    if float(rank.max()) == 0:
        message = "the noise is 0 everywhere, so that V jumps from 0 to 1, which no network learns; add some noise."
        yield found(problem, "warning", "diffusion", message)
    elif float(rank.max()) < n:
        message = (
            f"the noise acts in {int(rank.max())} of {n} directions. Along the others V may jump, and at faces that "
            "paths cannot cross it need not take the value of the set. There is nothing to mend if this is meant."
        )
        yield found(problem, "note", "diffusion", message)
    elif float(rank.min()) < n:
        yield found(problem, "note", "diffusion", "the noise vanishes in some directions here.", x[rank < n][0])


def units_of_time(samples: Samples) -> Iterator[Finding]:
    """Drift is a rate per second and sigma one per square root of a second; neither knows the length of a step."""
    problem = samples.problem
    for part in ("drift", "diffusion"):
        code = getattr(getattr(type(problem), part), "__code__", None)
        names = set() if code is None else {*code.co_names, *code.co_varnames, *code.co_freevars}
        if used := sorted(name for name in names if name.lower().strip("_") in TIME_NAMES):
            unit = "units of the state per s" if part == "drift" else "units of the state per sqrt(s)"
            message = f"it uses {', '.join(used)}, but must return {unit}; the simulator multiplies by the step itself."
            yield found(problem, "warning", part, message)
    move = across_box(problem, *samples.outside)
    farthest = max(move.speed * problem.horizon, move.spread * problem.horizon**0.5)
    if farthest < STILL:
        message = (
            f"in the whole horizon of {problem.horizon:g} s drift and noise move a path by {farthest:.1g} of the box; "
            "are the horizon in s, drift per s and diffusion per sqrt(s)?"
        )
        yield found(problem, "warning", "drift", message)


def angles(samples: Samples) -> Iterator[Finding]:
    """A coordinate whose physics and sets repeat should be periodic."""
    problem, x, u = samples.problem, samples.x, samples.u
    states = problem.states
    for axis in range(states.dim):
        if axis in states.periodic:
            continue
        width = states.high[axis] - states.low[axis]
        for period in (*ANGLES, width):
            if width < COVERS * period:
                continue
            shifted, between = x.clone(), x.clone()
            shifted[:, axis] += period
            between[:, axis] += PART * period
            # Along a coordinate of a much larger scale nothing changes after a part of the period either.
            whole, physics = (
                alike(samples, x, shifted, u) and not alike(samples, x, between, u)
                for alike in (_alike, _alike_in_physics)
            )
            # Sets of an angle are often written for the box alone, where that is one turn wide.
            one_turn = physics and period in ANGLES and width < ONE_TURN * period
            if whole or one_turn:
                what = "drift, noise and sets" if whole else "drift and noise"
                message = (
                    f"{what} repeat after {period:.6g} along axis {axis}, which is not periodic; if it is an angle, "
                    f"write Box(..., periodic=[{axis}]) with a box as wide as its period."
                )
                yield found(problem, "warning" if whole else "note", "states", message)
                break


def steps(samples: Samples, dt: float | None, substeps: int | None, crossing: Crossing) -> Iterator[Finding]:
    """One control step must agree with one of ten times as many integration steps, and must not jump over a set."""
    problem = samples.problem
    # Holding the control may ask for a shorter step, whose faults are smaller than those that are looked for here.
    chosen = propose_time_steps(problem, dt, substeps, crossing=crossing, holding=False)
    if not chosen.error <= TOLERANCE:
        message = (
            f"with a control step of {chosen.dt:.4g} s and {chosen.substeps} integration steps, ten times as many "
            f"change it by {chosen.error:.1g} of the box, expected at most {TOLERANCE:g}; give a smaller env.dt or "
            "more env.substeps, or take the stiff part out of the drift."
        )
        yield found(problem, "warning", "drift", message)
    h = chosen.dt / chosen.substeps
    yield from _precision(samples, h)
    for move in chosen.moves[1:]:
        if max(move.speed * h, move.spread * h**0.5) > THIN:
            message = (
                f"in one integration step of {h:.3g} s drift and noise move a path by {move.speed * h:.2g} and "
                f"{move.spread * h**0.5:.2g} of the depth of {move.across}, which is thinner than a step."
            )
            yield found(problem, "warning", "target_level" if "target" in move.across else "avoid_level", message)


def _precision(samples: Samples, h: float) -> Iterator[Finding]:
    """Networks and paths are in single precision, which must resolve the moves of an integration step of length h."""
    states = samples.problem.states
    drift, sigma = _physics(samples, *samples.outside)
    moves = (drift.abs() * h + sigma.norm(dim=-1) * h**0.5).amax(0).tolist()
    for axis, move in enumerate(moves):
        farthest = max(abs(states.low[axis]), abs(states.high[axis]))
        apart = float(np.spacing(np.float32(farthest)))
        if 0 < move < apart / COARSE:
            message = (
                f"along axis {axis} paths move by at most {move:.2g} in an integration step of {h:.3g} s, and numbers "
                f"near {farthest:.7g} are {apart:.2g} apart in single precision; measure the coordinate from a point "
                "in the box, so that its numbers are small."
            )
            yield found(samples.problem, "warning", "states", message)


def _physics(samples: Samples, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    return samples.problem.drift(x, u), samples.problem.diffusion(x, u)


def _alike(samples: Samples, x: Tensor, other: Tensor, u: Tensor) -> bool:
    """Whether drift, noise and membership of both sets are the same at the states x and other (N, n)."""
    sets = (samples.problem.reached, samples.problem.failed)
    return _alike_in_physics(samples, x, other, u) and all(torch.equal(inside(x), inside(other)) for inside in sets)


def _alike_in_physics(samples: Samples, x: Tensor, other: Tensor, u: Tensor) -> bool:
    """Whether drift and noise are the same at the states x and other (N, n)."""
    pairs = zip(_physics(samples, x, u), _physics(samples, other, u), strict=True)
    sizes = ((one, two, float(1 + one.nan_to_num(0.0).abs().max())) for one, two in pairs)
    return all(torch.allclose(one, two, rtol=1e-9, atol=1e-9 * size, equal_nan=True) for one, two, size in sizes)
