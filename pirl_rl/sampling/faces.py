"""Points on the faces of A and B, and initial states of episodes near them.

A face is found by bisection of the segment from a point inside a set to one outside both sets. Points inside are found
by sampling a box twice as wide as `states`, and where that finds few of them, by descent of the levels of the set.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.descent import descended
from pirl_rl.errors import ArgumentError, ProblemError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates, mixed, sample_interior

FACE_POOL = 16_384
"""The number of points on the faces that are found once, and from which samples are drawn."""

BISECTIONS = 50
"""The number of halvings of a segment between a point inside a set and one outside; enough for double precision."""

FEW = 256
"""With fewer sampled points in a set than this, points that are found by descent are added."""


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
    candidates = wide.sample(4 * FACE_POOL, rng, dtype=torch.float64)
    interior = candidates[problem.interior(candidates)]
    if len(interior) < FEW:
        interior = torch.cat([interior, sample_interior(problem, problem.states, FEW, rng, torch.float64)])
    found = []
    for name, absorbs, value, levels in _sets(problem):
        parts = [_inside(absorbs, part, candidates, problem, rng) for part in levels]
        parts = [inside for inside in parts if len(inside)]
        if not parts:
            raise ProblemError(
                f"{type(problem).__name__}: no point of the {name} was found, neither among {len(candidates)} points "
                f"of {wide} nor by descent of its levels; expected a set that overlaps this box, and levels that fall "
                "towards it"
            )
        # Each part of a union has the same number of points, however small it is.
        count = FACE_POOL // 2 // len(parts)
        a = torch.cat([inside[torch.randint(len(inside), (count,), generator=rng)] for inside in parts])
        count = len(a)
        b = interior[torch.randint(len(interior), (count,), generator=rng)]
        face = _bisect(absorbs, a, b)
        near = wide.contains(face)
        found.append((face[near], torch.full((int(near.sum()),), value), b[near]))
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


Levels = Callable[[Tensor], Tensor]


def _sets(problem: ReachAvoidProblem) -> list[tuple[str, Levels, float, list[Levels]]]:
    """A and B, as far as they absorb: name, membership, V, and the levels of each part of a union."""
    sets: list[tuple[str, Levels, float, list[Levels]]] = []
    if problem.objective == "reach-avoid":
        sets.append(("target", problem.reached, 1.0, [problem.reached_constraints]))
    if problem.has_avoid_set:
        count = problem.avoid_constraints(problem.states.sample(1, torch.Generator().manual_seed(0))).shape[-1]
        parts: list[Levels] = [lambda x, i=i: problem.avoid_constraints(x)[..., i : i + 1] for i in range(count)]
        sets.append(("avoid set", problem.failed, 0.0, parts))
    return sets


def _inside(
    absorbs: Levels, part: Levels, candidates: Tensor, problem: ReachAvoidProblem, rng: torch.Generator
) -> Tensor:
    """Points (K, n) of a part of a set: the candidates in it, and if they are few, points found by descent."""
    inside = candidates[(part(candidates) <= 0).all(-1)]
    if len(inside) < FEW:
        starts = problem.states.sample(FEW, rng, candidates.dtype)
        inside = torch.cat([inside, descended(part, starts, problem.states)])
    return inside[(part(inside) <= 0).all(-1) & absorbs(inside)]


def _bisect(absorbs: Levels, inside: Tensor, outside: Tensor) -> Tensor:
    """The points (N, n) at which the segments from points inside to points outside leave the set."""
    for _ in range(BISECTIONS):
        middle = (inside + outside) / 2
        held = absorbs(middle).unsqueeze(-1)
        inside, outside = torch.where(held, middle, inside), torch.where(held, outside, middle)
    return inside


def _single(points: Tensor, values: Tensor, outside: Tensor) -> Faces:
    """The faces with torch's default dtype."""
    dtype = torch.get_default_dtype()
    return Faces(points.to(dtype), values.to(dtype), outside.to(dtype))
