"""What a model is and what its numbers mean, as plain values for a JSON file."""

from __future__ import annotations

from typing import Any

from pirl_rl.checkpoint import digest
from pirl_rl.sets import Box
from pirl_rl.solution import Solution


def describe(solution: Solution) -> dict[str, Any]:
    """The description of the model of a solution.

    Returns:
        The class of the problem and its objective, the horizon in s, the boxes of states and controls in SI units, the
        SHA-256 of the networks, and shape, type, unit and meaning of each input and output.
    """
    problem = solution.problem
    n, m = problem.states.dim, problem.controls.dim
    kind = str(solution.dtype).removeprefix("torch.")

    def array(shape: list[str | int], unit: str, meaning: str) -> dict[str, Any]:
        return {"shape": shape, "type": kind, "unit": unit, "meaning": meaning}

    return {
        "problem": type(problem).__name__,
        "objective": problem.objective,
        "horizon": problem.horizon,
        "states": _corners(problem.states),
        "controls": _corners(problem.controls),
        "networks": digest(solution.arrays()),
        "inputs": {
            "tau": array(["N"], "s", "time to go, from 0 to the horizon"),
            "x": array(["N", n], "SI", "state; a periodic coordinate may lie outside its period"),
        },
        "outputs": {
            "value": array(["N"], "1", "probability of success, exactly 1 in the target and 0 where it is lost"),
            "gradient": array(["N", n], "1 per unit of x", "gradient of the networks' value in x, without the masks"),
            "control": array(["N", m], "SI", "control of the policy"),
        },
    }


def _corners(box: Box) -> dict[str, Any]:
    return {"low": list(box.low), "high": list(box.high), "periodic": list(box.periodic)}
