"""Evidence about a learned solution. An evaluator is called with a `Solution` and returns named numbers; those that are
a `Measurement` also keep what they measured, to be drawn.

All are noise-free and repeatable: fixed seeds, own generators. The simulator of each is its dt, substeps and crossing
arguments; training passes those of the environment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from pirl_rl.evaluation import accuracy, slices
from pirl_rl.evaluation.accuracy import Accuracy
from pirl_rl.evaluation.calibration import Calibration
from pirl_rl.evaluation.evidence import draw_evidence
from pirl_rl.evaluation.exact_error import ExactError
from pirl_rl.evaluation.residuals import Residuals
from pirl_rl.evaluation.rollouts import Rollouts
from pirl_rl.evaluation.slices import Slices
from pirl_rl.evaluation.success import Success
from pirl_rl.solution import Solution

__all__ = [
    "METRICS",
    "Accuracy",
    "Calibration",
    "Evaluator",
    "ExactError",
    "Residuals",
    "Rollouts",
    "Slices",
    "Success",
    "draw_evidence",
    "evaluate",
]

Evaluator = Callable[[Solution], dict[str, float]]


def _told(settings: Mapping[str, object]) -> str:
    return ", ".join(f"{name} {value}" for name, value in settings.items())


METRICS: dict[str, str] = {
    "value_mse": "mean square error of the raw network's V on the 101 x 201 grid of tau in [0, T] and x in states, "
    "edges included (n > 1: as many random points)",
    "value_max_error": "largest absolute error on the same points",
    "masked_value_mse": "as value_mse, with V set to 1 in A and 0 in B",
    "calibration_mse": "mean square of masked V minus Monte Carlo of the learned policy, at 256 random (tau, x) "
    "outside A and B (drift: of the law of starts, 64 paths each), 256 paths each, training's simulator",
    "calibration_mae": "mean absolute value of the same difference",
    "calibration_noise": "calibration_mse that a perfect V would have: the variance of the Monte Carlo mean",
    "success_rate": "share of 10,000 noise-free episodes that reach A before B (invariance: avoid B), from training's "
    "initial law (drift: full-scale starts, random tau), simulator and whole steps; hard sets whatever the payoff",
    "success_low": "lower end of its 95% Wilson interval",
    "success_high": "upper end of its 95% Wilson interval",
    "reward": "mean payoff l_eps of the same episodes; equals success_rate for the hard payoff",
    "value_spread": "standard deviation of V, raw but clamped to [0, 1], over the starts of the same episodes: 0 where "
    "V is a constant",
    "optimal_reward": "reward of the optimal control from the same starts and seed, where it is known",
    "hjb_loss": "mean (L^pi V)^2, 1/s^2, at 4,096 held-out Sobol points outside A and B (drift: at the "
    "reference states from which the target can be reached), raw V",
    "hjb_sup_loss": "mean (max_u L^u V)^2, 1/s^2, at the same points: the HJB equation itself",
    "value_slope": "mean |grad V| at the same points, in coordinates in which `states` is [-1, 1]^n, raw V",
    "boundary_loss": "mean (V - l_eps)^2 at 4,096 held-out points, half at tau = 0, half on the faces of A and B; "
    "raw V",
    "td_loss": "mean (V(y) - r - (1 - d) V(y'))^2 of 4,096 held-out one-step transitions, training's simulator, raw V; "
    "includes the variance of V(y')",
    **{
        f"{simulator}_{name}": f"{meaning}; {simulator} simulator, {_told(settings)}"
        for simulator, settings in accuracy.SIMULATORS.items()
        for name, meaning in accuracy.MEANINGS.items()
    },
    **{
        name.replace("<plane>", plane): meaning
        for plane in ("beta_r", "e_y_e_psi")  # of VehicleDrift; those of other problems read alike
        for name, meaning in slices.MEANINGS.items()
    },
}
"""Every metric: what it is, from which sample and simulator, with the default sizes."""


def evaluate(solution: Solution, evaluators: Iterable[Evaluator]) -> dict[str, float]:
    """The metrics of all evaluators, in their order."""
    metrics: dict[str, float] = {}
    for evaluator in evaluators:
        metrics.update(evaluator(solution))
    return metrics
