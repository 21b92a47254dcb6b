"""Points on the faces of A and B, and initial states of episodes near them.

A face is found by bisection of the segment from a point inside a set to one outside both sets. Half of the candidates
for both are drawn from `states`, and half from a box twice as wide. From states everywhere, descent of the levels of
the set finds as many points inside again: parts of a set that are apart, such as two targets in one level, have points
however small they are.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.descent import FEWER_STEPS, STEPS, bisected, descended_parts, starts_of_a_part
from pirl_rl.errors import ArgumentError, ProblemError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates, mixed, sample_interior
from pirl_rl.structure import AbsorbingSet, absorbing_sets

FACE_POOL = 16_384
"""The number of points on the faces that are found once, and from which samples are drawn."""

DESCENTS = 256
"""The number of states from which the levels of each part of a set are descended."""


class Faces(NamedTuple):
    """Points on the faces of A and B.

    Attributes:
        points: the points (K, n).
        values: V (K,) there.
        outside: states (K, n) outside A and B; the segment from a point to its state starts outside the set, unless the
            problem itself gives the points.
    """

    points: Tensor
    values: Tensor
    outside: Tensor


def find_faces(problem: ReachAvoidProblem, rng: torch.Generator) -> Faces:
    """About `FACE_POOL` points: those that `problem.faces` gives, or else half of them for each set.

    Raises:
        ProblemError: the problem has no set, or no point of a set is found; the message names the set.
    """
    given = problem.faces(FACE_POOL, rng)
    if given is not None:
        points, values = given
        points = problem.states.wrap(points)
        outside = sample_interior(problem, problem.states, len(points), rng, points.dtype)
        return _single(points, values, outside)
    wide = problem.states.expand(2.0)
    # In a wide box alone hardly any point would be near `states` if these have many coordinates.
    candidates = torch.cat([box.sample(2 * FACE_POOL, rng, dtype=torch.float64) for box in (problem.states, wide)])
    interior = candidates[problem.interior(candidates)]
    if len(interior) < DESCENTS:
        interior = torch.cat([interior, sample_interior(problem, problem.states, DESCENTS, rng, torch.float64)])
    found = []
    for absorbing in absorbing_sets(problem):
        # All parts are asked at once, since a union may have many.
        holds, absorbed = absorbing.levels(candidates) <= 0, absorbing.contains(candidates)
        sampled = [candidates[holds[:, part].all(-1) & absorbed] for part in absorbing.parts]
        parts = [ways for ways in _inside(absorbing, sampled, problem, rng) if ways]
        if not parts:
            raise ProblemError(
                f"{type(problem).__name__}: no point of the {absorbing.name} was found, neither among "
                f"{len(candidates)} points of {wide} nor by descent of its levels; expected a set that overlaps this "
                "box, and levels that fall towards it"
            )
        # Each part of a union has the same number of points, however small it is, half of them from each way.
        count = FACE_POOL // 2 // len(parts)
        a = torch.cat([_drawn(inside, count // len(ways), rng) for ways in parts for inside in ways])
        b = _drawn(interior, len(a), rng)
        face = bisected(absorbing.contains, a, b)
        near = wide.contains(face)
        found.append((face[near], torch.full((int(near.sum()),), absorbing.value), b[near]))
    if not found:
        raise ProblemError(f"{type(problem).__name__}: expected a target or an avoid set, got neither")
    return _single(*(torch.cat(parts) for parts in zip(*found, strict=True)))


class NearFaces:
    """Some of the states near the faces of A and B, the rest from another distribution.

    Near a face V may change within a layer whose width nobody knows in advance. The distance from a point of a face is
    therefore log-uniform, so that each decade of it has as many states: a state is f + 10^(-decades U) (s - f), with f
    on the face, s a state outside the sets and U uniform in [0, 1]. A state that then lies in A or B or
    outside the box of states, or is unreachable, is replaced by one of the other distribution.

    Args:
        others: the other distribution, which also gives the steps to go of all episodes.
        share: the probability of a state near a face, in [0, 1].
        decades: the range of distances, in powers of ten, > 0.

    Raises:
        ArgumentError: a number is out of range.
    """

    common = True

    def __init__(self, others: InitialStates, share: float = 0.3, decades: float = 3.0):
        if not 0 <= share <= 1 or not decades > 0:
            raise ArgumentError(f"initial_states: expected 0 <= share <= 1 and decades > 0, got {share} and {decades}")
        self.others, self.share, self.decades = others, share, decades
        self._found: tuple[ReachAvoidProblem, Faces] | None = None

    def sample(
        self,
        problem: ReachAvoidProblem,
        count: int,
        max_steps: int,
        rng: torch.Generator,
        dtype: torch.dtype,
        visited: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        steps, x = self.others.sample(problem, count, max_steps, rng, dtype, visited)
        faces, device = self._faces(problem), rng.device
        if not len(faces.points):  # all faces are outside the box of states
            return steps, x
        index = torch.randint(len(faces.points), (count,), generator=rng, device=device)
        points, outside = (entry.to(device=device, dtype=dtype)[index] for entry in (faces.points, faces.outside))
        distance = 10 ** (-self.decades * torch.rand((count, 1), generator=rng, dtype=dtype, device=device))
        near = problem.states.wrap(points + distance * (outside - points))
        near = torch.where(problem.states.contains(near).unsqueeze(-1), near, x)
        return steps, mixed(problem, near, x, self.share, rng)

    def _faces(self, problem: ReachAvoidProblem) -> Faces:
        """The faces of a problem within its box of states, found once."""
        if self._found is None or self._found[0] is not problem:
            faces = find_faces(problem, torch.Generator().manual_seed(0))
            # Faces along the edges of the box must not be lost to rounding.
            kept = problem.states.expand(1.01).contains(faces.points)
            self._found = problem, Faces(*(entry[kept] for entry in faces))
        return self._found[1]


def _inside(
    absorbing: AbsorbingSet, sampled: list[Tensor], problem: ReachAvoidProblem, rng: torch.Generator
) -> list[list[Tensor]]:
    """Points (K, n) of each part of a set: those that were sampled, and others that descents find, as far as there are
    any.

    A few sampled points are joined to the others, since they would be drawn again and again.
    """
    levels, own = absorbing.levels, absorbing.parts
    count = starts_of_a_part(DESCENTS, len(own))
    few = [len(points) < DESCENTS for points in sampled]
    starts = problem.states.sample(len(own) * count, rng, torch.float64).unflatten(0, (len(own), count))
    deep = descended_parts(levels, own, starts, problem.states, STEPS if any(few) else FEWER_STEPS)
    parts = []
    for part, points, ends, joined in zip(own, sampled, deep, few, strict=True):
        found = ends[(levels(ends)[:, part] <= 0).all(-1) & absorbing.contains(ends)]
        ways = [torch.cat([points, found])] if joined else [points, found]
        parts.append([inside for inside in ways if len(inside)])
    return parts


def _drawn(points: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """So many of the points (K, n), drawn with replacement."""
    return points[torch.randint(len(points), (count,), generator=rng)]


def _single(points: Tensor, values: Tensor, outside: Tensor) -> Faces:
    """The faces with torch's default dtype."""
    dtype = torch.get_default_dtype()
    return Faces(points.to(dtype), values.to(dtype), outside.to(dtype))
