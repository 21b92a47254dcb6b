"""V and the control of a problem with one state, over the time to go and the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from pirl_rl.problem import closed_form
from pirl_rl.reports.maps import MOST_CONTROLS, evaluated
from pirl_rl.reports.names import as_html, state_names
from pirl_rl.reports.packing import packed, quantised
from pirl_rl.solution import Solution

TAUS, POINTS = 81, 161
"""The numbers of times to go and of states."""

LARGEST = 65_535
"""The code of the largest number, so that curves have no visible steps."""


def line_maps(
    solution: Solution, bounds: Mapping[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]
) -> dict[str, Any]:
    """V, the exact V where it is known, proved bounds by name, and the control of a problem with one state."""
    problem = solution.problem
    tau = torch.linspace(0, problem.horizon, TAUS, dtype=torch.float64)
    x = torch.linspace(problem.states.low[0], problem.states.high[0], POINTS, dtype=torch.float64)
    pairs = tau.repeat_interleave(POINTS), problem.states.wrap(x.repeat(TAUS).unsqueeze(-1))
    curves = {"value": evaluated(solution, solution.value, *pairs)}
    exact = closed_form(problem, *pairs)
    if exact is not None:
        curves["exact"] = exact.numpy()
    interior = problem.interior(pairs[1]).numpy()
    for name, bound in bounds.items():
        curves[name] = np.where(interior, bound(*(entry.numpy() for entry in pairs)), curves["value"])
    control, box = evaluated(solution, solution.policy, *pairs), problem.controls
    return {
        "label": as_html(state_names(problem)[0]),
        "low": problem.states.low[0],
        "high": problem.states.high[0],
        "periodic": bool(problem.states.periodic),
        "points": POINTS,
        "taus": tau.tolist(),
        "start": TAUS - 1,
        "curves": {name: packed(quantised(curve, 0.0, 1.0, LARGEST, 16)) for name, curve in curves.items()},
        "control": [
            packed(quantised(control[:, j], box.low[j], box.high[j], LARGEST, 16))
            for j in range(min(box.dim, MOST_CONTROLS))
        ],
    }
