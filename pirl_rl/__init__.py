"""Stochastic reach-avoid analysis of controlled systems by physics-informed reinforcement learning.

Names are imported on first use, so that `import pirl_rl` itself loads neither torch nor any other library.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pirl_rl import problems as problems
    from pirl_rl.api import check, evaluate, load_run, monte_carlo, train
    from pirl_rl.constants import constant
    from pirl_rl.filters import ReachAvoidFilter
    from pirl_rl.losses import PIRLLoss
    from pirl_rl.operators import generator
    from pirl_rl.problem import ReachAvoidProblem
    from pirl_rl.runs.run import Run
    from pirl_rl.sets import Box, Plane, band, complement, difference, intersection, union
    from pirl_rl.simulator import Simulator

__version__ = "0.1.0"

__all__ = [
    "Box",
    "PIRLLoss",
    "Plane",
    "ReachAvoidFilter",
    "ReachAvoidProblem",
    "Run",
    "Simulator",
    "__version__",
    "band",
    "check",
    "complement",
    "constant",
    "difference",
    "evaluate",
    "generator",
    "intersection",
    "load_run",
    "monte_carlo",
    "problems",
    "train",
    "union",
]

_MODULE_OF = {
    **dict.fromkeys(("load_run", "monte_carlo"), "pirl_rl.api"),
    **dict.fromkeys(("Box", "Plane", "band", "complement", "difference", "intersection", "union"), "pirl_rl.sets"),
    "PIRLLoss": "pirl_rl.losses",
    "constant": "pirl_rl.constants",
    "generator": "pirl_rl.operators",
    "ReachAvoidFilter": "pirl_rl.filters",
    "ReachAvoidProblem": "pirl_rl.problem",
    "Run": "pirl_rl.runs.run",
    "Simulator": "pirl_rl.simulator",
}
"""The module of each name."""

_MODULES = ("problems", "check", "train", "evaluate")
"""Modules of the package. Those of the commands `check`, `train` and `evaluate` can be called, like the functions."""


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        value = getattr(import_module(_MODULE_OF[name]), name)
    elif name in _MODULES:
        value = import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
