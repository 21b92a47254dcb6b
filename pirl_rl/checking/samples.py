"""The states and controls at which a problem is checked, and its methods as functions of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from itertools import islice, product

import torch
from torch import Tensor

from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.faces import Faces, find_faces

STATES = 1_024
"""The number of random states in the box, and of those in the box that is half as wide again."""

CORNERS = 64
"""The largest numbers of corners of the box and of points half way to its sides that are added."""

BEYOND = 1.5
"""Widths of the box that paths are taken to reach, in widths of `states`."""

LEVELS = ("target_level", "target_constraints", "avoid_level", "avoid_constraints")

Function = Callable[[Tensor, Tensor], Tensor]


class Samples:
    """States in and around the box, controls, and the methods that a problem defines.

    Attributes:
        problem: the problem.
        x: states (N, n) in the box, with its centre, its corners and points half way to its sides, float64.
        u: controls (N, m), half of them vertices.
        beyond: states (N, n) in the wider box, of which most lie outside `states`.
        methods: the methods that the problem defines, as functions of x and u, by name.
    """

    def __init__(self, problem: ReachAvoidProblem, seed: int = 0):
        rng, states = torch.Generator().manual_seed(seed), problem.states
        corners = torch.tensor([*islice(product((-1.0, 1.0), repeat=states.dim), CORNERS)], dtype=torch.float64)
        axes = torch.eye(states.dim, dtype=torch.float64)
        # The centre may lie in a set, and then points beside it show what has no number where a coordinate is 0.
        special = torch.cat([0 * axes[:1], corners, torch.cat([axes, -axes])[:CORNERS] / 2])
        special = states.wrap(states.denormalize(special))
        self.problem = problem
        self.x = torch.cat([states.sample(STATES, rng, torch.float64), special])
        self.beyond = states.expand(BEYOND).sample(len(self.x), rng, torch.float64)
        action = 2 * torch.rand(len(self.x), problem.controls.dim, generator=rng, dtype=torch.float64) - 1
        action[::2] = action[::2].sign()
        self.u = problem.controls.denormalize(action)
        self.methods: dict[str, Function] = {"drift": problem.drift, "diffusion": problem.diffusion}
        for name in (*LEVELS, "unreachable"):
            if defines(problem, name):
                self.methods[name] = _of_states(getattr(problem, name))

    @cached_property
    def outside(self) -> tuple[Tensor, Tensor]:
        """Those of the states x outside A and B, where the physics is asked, with their controls u; else all."""
        outside = self.problem.interior(self.x)
        return (self.x[outside], self.u[outside]) if outside.any() else (self.x, self.u)

    @cached_property
    def faces(self) -> Faces:
        """Points on the faces of A and B.

        Raises:
            ProblemError: no point of a set is found.
        """
        return find_faces(self.problem, torch.Generator().manual_seed(0))


def defines(problem: ReachAvoidProblem, name: str) -> bool:
    """Whether the class of a problem defines a method itself."""
    return getattr(type(problem), name) is not getattr(ReachAvoidProblem, name)


def _of_states(method: Callable[[Tensor], Tensor]) -> Function:
    return lambda x, u: method(x)
