"""The suite: problems with known answers, and the scores of the default recipe on them."""

from pirl_rl.scoring.alternatives import Alternative, play_rival, race_grid
from pirl_rl.scoring.score import Score, measure
from pirl_rl.scoring.table import markdown
from pirl_rl.scoring.truth import Truth, find_truth

__all__ = [
    "PROBLEMS",
    "Alternative",
    "Score",
    "Truth",
    "find_truth",
    "markdown",
    "measure",
    "play_rival",
    "race_grid",
]

PROBLEMS: dict[str, tuple[str, ...]] = {
    "reach1d": ("+experiment=reach1d",),
    "safety1d": ("+experiment=safety1d",),
    "exit1d": ("+experiment=exit1d",),
    "halfspace-2": ("+experiment=halfspace", "env.problem.dim=2"),
    "halfspace-8": ("+experiment=halfspace", "env.problem.dim=8"),
    "halfspace-32": ("+experiment=halfspace", "env.problem.dim=32"),
    "halfspace-100": ("+experiment=halfspace", "env.problem.dim=100"),
    "radial_exit-2": ("+experiment=radial_exit", "env.problem.dim=2"),
    "radial_exit-8": ("+experiment=radial_exit", "env.problem.dim=8"),
    "radial_exit-32": ("+experiment=radial_exit", "env.problem.dim=32"),
    "radial_exit-100": ("+experiment=radial_exit", "env.problem.dim=100"),
    "double_integrator": ("+experiment=double_integrator",),
    "double_integrator-degenerate": ("+experiment=double_integrator", "env.problem.position_noise=0.0"),
    "pendulum": ("+experiment=pendulum",),
    "zermelo": ("+experiment=zermelo",),
    "dubins": ("+experiment=dubins",),
    "drift3": ("+experiment=drift3",),
    "cartpole": ("+experiment=cartpole",),
    "quadrotor": ("+experiment=quadrotor",),
}
"""The overrides of `python -m pirl_rl.train` for each problem of the suite."""
