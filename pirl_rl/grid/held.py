"""The success that a policy loses because it holds each control for a control step.

A path that plays u where u* is the best control loses V at the rate (f(x, u*) - f(x, u)) . grad V, which is the
difference of the Hamiltonians in the HJB equation. The mean of what it loses over the horizon is the difference of the
values of both policies (S. Kakade and J. Langford, ICML 2002, Lemma 6.1). It needs far fewer paths than the difference
of their frequencies of success. Noise that depends on the control would have a part in the Hamiltonian, too, but the
second derivatives of V on a grid are too rough for it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pirl_rl.grid.solution import GridSolution
from pirl_rl.sampling.initial_states import sample_interior
from pirl_rl.simulator import Simulator

STILL = 1e-12
"""The least speed, in node distances per s, by which is divided."""


class Loss(NamedTuple):
    """A mean loss of success and its standard error."""

    mean: float
    error: float


@torch.no_grad()
def loss_of_holding(solution: GridSolution, dt: float, substeps: int = 1, paths: int = 2000, seed: int = 0) -> Loss:
    """The success that paths lose whose policy holds its controls for dt, from random states and times to go.

    While a control is held, its loss grows in proportion to the time for which it has been held, so that the rate in
    the middle of a control step is the mean over the step.

    Args:
        solution: of a grid, for V and the policy; sigma must not depend on the control.
        dt: the length of a control step, in s.
        substeps: the number of integration steps in half a control step.
        paths: the number of paths, at least 2, whose starts are uniform in time and in the box outside A and B.
        seed: of the starts and the noise.

    Raises:
        ProblemError: no state outside A and B is found.
    """
    problem, rng = solution.problem, torch.Generator().manual_seed(seed)
    half = Simulator(problem, dt / 2, substeps)
    x = sample_interior(problem, problem.states, paths, rng, torch.float64)
    left = torch.randint(1, 1 + round(problem.horizon / dt), (paths,), generator=rng)
    path, total = torch.arange(paths), torch.zeros(paths, dtype=x.dtype)
    while len(x):
        u = solution.policy(left * dt, x)
        # Exits between the ends of a step matter little here and take most of its time.
        step = half.step(x, u, rng, crossings=False)
        inside = ~(step.reached | step.failed)
        x, u, left, path = step.state[inside], u[inside], left[inside], path[inside]
        tau = (left - 0.5) * dt
        best = solution.policy(tau, x)
        late = (best != u).any(-1)
        total[path[late]] += dt * _rate(solution, tau[late], x[late], best[late], u[late])
        step = half.step(x, u, rng, crossings=False)
        inside = ~(step.reached | step.failed) & (left > 1)
        x, left, path = step.state[inside], left[inside] - 1, path[inside]
    return Loss(total.mean().item(), total.std().item() / paths**0.5)


def _rate(solution: GridSolution, tau: Tensor, x: Tensor, best: Tensor, u: Tensor) -> Tensor:
    """The rates (P,), in 1/s, at which paths at tau (P,) and x (P, n) lose V with the controls u instead of `best`.

    The slope of V along the difference of both drifts is that between points one node distance apart.
    """
    problem, field = solution.problem, solution.field
    gain = (problem.drift(x, best) - problem.drift(x, u)).nan_to_num(0.0)
    duration = 1 / (gain.abs() / torch.from_numpy(solution.mesh.spacing)).amax(-1).clamp(min=STILL)
    move = gain * (duration / 2).unsqueeze(-1)
    return (field(tau, problem.states.wrap(x + move)) - field(tau, problem.states.wrap(x - move))) / duration
