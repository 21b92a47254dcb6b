"""Evidence about a learned solution: evaluators measure it and state what each of their metrics means.

All evaluators play the policy without exploration noise. Each has its own seed, so that repeated calls give the same
numbers. All get the same simulator, except `Accuracy`, which compares simulators and builds its own. Figures are drawn
in `pirl_rl.figures`.
"""

from pirl_rl.evaluation.accuracy import Accuracy
from pirl_rl.evaluation.calibration import Calibration
from pirl_rl.evaluation.evaluator import (
    Evaluator,
    Evidence,
    Metrics,
    evaluate,
    lines_of,
    meanings_of,
    metrics_of,
    statements_of,
)
from pirl_rl.evaluation.exact_error import ExactError
from pirl_rl.evaluation.residuals import Residuals
from pirl_rl.evaluation.rollouts import Rollouts
from pirl_rl.evaluation.slices import Slices
from pirl_rl.evaluation.success import Success
from pirl_rl.evaluation.verdict import Verdict

__all__ = [
    "Accuracy",
    "Calibration",
    "Evaluator",
    "Evidence",
    "ExactError",
    "Metrics",
    "Residuals",
    "Rollouts",
    "Slices",
    "Success",
    "Verdict",
    "evaluate",
    "lines_of",
    "meanings_of",
    "metrics_of",
    "statements_of",
]
