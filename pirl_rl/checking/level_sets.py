"""Checks of the target and the avoid set: whether they are found, where they lie, and how large they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from pirl_rl.checking.findings import Finding, found
from pirl_rl.checking.samples import Samples, defines
from pirl_rl.descent import descended
from pirl_rl.errors import ProblemError
from pirl_rl.problem import RANDOM_STATES, WIDER, ReachAvoidProblem
from pirl_rl.sampling.initial_states import sample_interior

STARTS = 64
"""The number of states from which points of a set in the box are searched."""

MOST = 0.95
"""The share of the box from which a set is suspected to have the wrong sign."""

MUCH = 0.5
"""The share of the box from which a set is mentioned: few problems mean one that large."""

NEAR = 1e-3
"""How far from a face its level is taken, as a share of the way to a state outside."""

LEAST_SLOPE = 0.1
"""The slope of a level at a face, in units of its mean slope along `NEAR`, below which it counts as flat."""


def agreement(samples: Samples) -> Iterator[Finding]:
    """A set that is given by one level and by several must be the same set."""
    problem, x = samples.problem, samples.x
    for which, holds in (("target", torch.all), ("avoid", torch.any)):
        level, constraints = f"{which}_level", f"{which}_constraints"
        if not (defines(problem, level) and defines(problem, constraints)):
            continue
        differs = (getattr(problem, level)(x) <= 0) != holds(getattr(problem, constraints)(x) <= 0, -1)
        if differs.any():
            message = f"it gives another set than {constraints}; define one of the two."
            yield found(problem, "error", level, message, x[differs][0])


def sizes(samples: Samples) -> Iterator[Finding]:
    """Neither set may fill the box, and most of it should be outside both."""
    problem = samples.problem
    for what, part, inside in _sets(samples):
        share = float(inside.double().mean())
        if share >= MOST:
            message = f"the {what} fills {share:.0%} of the box; its level must be <= 0 inside and > 0 outside the set."
            yield found(problem, "warning", part, message)
        elif share >= MUCH:
            message = f"the {what} fills {share:.0%} of the box; paths start in the rest of it.{_combination(part)}"
            yield found(problem, "note", part, message)
    try:
        sample_interior(problem, problem.states, 1, torch.Generator().manual_seed(0), torch.float64)
    except ProblemError:
        message = "expected states outside the target and the avoid set, at which episodes start, got none in the box."
        yield found(problem, "error", "states", message)


def overlap(samples: Samples) -> Iterator[Finding]:
    """The sets should be disjoint; a state in both is a failure, see `ReachAvoidProblem.free_target_constraints`."""
    problem = samples.problem
    if not problem.shared_constraints:
        return
    both, part = problem.overlap(), _part(samples, "target")
    inside = problem.states.contains(both)
    shown = both[inside][0] if inside.any() else both[0]
    count = f"{len(both):,} of {RANDOM_STATES:,} random states in a box {WIDER:g} times as wide as that of the states"
    if problem.reached(problem.random_states()).any():
        message = (
            f"target and avoid set overlap, at {count}. States in both count as failures; there is nothing to mend if "
            "this is meant."
        )
        yield found(problem, "warning", part, message, shown)
    else:
        message = f"expected a target outside the avoid set, got one that lies in it, with {count} in both."
        yield found(problem, "error", part, message, shown)


def places(samples: Samples) -> Iterator[Finding]:
    """Both sets must exist near the box, and should overlap it."""
    problem = samples.problem
    try:
        faces = samples.faces
    except ProblemError as error:
        part = _part(samples, "avoid" if "of the avoid set" in str(error) else "target")
        yield found(problem, "error", part, f"{error}".partition(": ")[2] + ".")
        return
    # The descent stays in a box twice as wide as the one that it is given.
    rng, narrow = torch.Generator().manual_seed(0), problem.states.expand(0.505)
    for what, part, inside in _sets(samples):
        own = faces.points[faces.values.round() == (what == "target")]
        if inside.any() or problem.states.expand(1.01).contains(own).any():
            continue
        level, absorbs = _level(problem, what), problem.reached if what == "target" else problem.failed
        lowest = descended(lambda x, level=level: level(x).unsqueeze(-1), narrow.sample(STARTS, rng), narrow)
        if not absorbs(lowest).any():
            message = (
                f"the {what} lies outside the box of states, in which paths start and V is learned; widen the box "
                "until it touches the set."
            )
            yield found(problem, "warning", part, message, own[0] if len(own) else None)


def slopes(samples: Samples) -> Iterator[Finding]:
    """Levels must change at a face in proportion to the distance: from the slope follows how likely paths cross it."""
    problem = samples.problem
    if problem.faces(1, torch.Generator()) is not None:
        return
    faces = samples.faces
    for what, part, _ in _sets(samples):
        on_target = what == "target"
        own = faces.values.round() == on_target
        face, way = faces.points[own].double(), NEAR * (faces.outside[own] - faces.points[own]).double()
        constraints = problem.reached_constraints if on_target else problem.avoid_constraints
        levels = problem.states.within_period(constraints)
        here = levels(face)
        # Just outside, since a level may be 0 all over the set.
        slope = torch.func.jvp(levels, (face + way / 100,), (way,))[1]
        flat = slope.abs() < LEAST_SLOPE * (levels(face + way) - here).abs()
        active = here.argmax(-1) if on_target else here.argmin(-1)
        for index in active.unique():
            at = face[(active == index) & flat[:, index]]
            if 2 * len(at) > int((active == index).sum()):
                message = (
                    f"the level has no slope at a face of the {what}, so that paths cross it unseen between the ends "
                    "of a step; expected one that changes there in proportion to the distance."
                )
                yield found(problem, "warning", part, message, at[0])
                break


def _level(problem: ReachAvoidProblem, what: str) -> Callable[[Tensor], Tensor]:
    """The level (*) of a set, at states (*, n); that of a smoothed payoff for the target."""
    if what == "avoid set":
        return problem.scaled_avoid_level
    return problem.scaled_reached_level


def _combination(part: str) -> str:
    """How several constraints make up a set, for a set that is given by them."""
    return {
        "target_constraints": " A state is in the target where all the constraints are <= 0.",
        "avoid_constraints": " A state is in the avoid set where at least one of the constraints is <= 0.",
    }.get(part, "")


def _sets(samples: Samples):
    """Each set that absorbs: its name, the method that defines it, and which of the states lie in it."""
    problem, x = samples.problem, samples.x
    if problem.objective == "reach-avoid":
        yield "target", _part(samples, "target"), problem.reached(x)
    if problem.has_avoid_set:
        yield "avoid set", _part(samples, "avoid"), problem.failed(x)


def _part(samples: Samples, which: str) -> str:
    """The method by which the class defines a set."""
    names = (f"{which}_level", f"{which}_constraints")
    return next((name for name in names if defines(samples.problem, name)), names[0])
