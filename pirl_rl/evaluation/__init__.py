"""Evidence about a learned solution: evaluators measure it, and say what each of their metrics means.

All evaluators leave exploration noise out, and every call repeats the one before: they have seeds and random generators
of their own. One simulator is handed to all of them; `Accuracy`, which compares simulators, has its own. Nothing is
drawn here, see `pirl_rl.figures`.
"""

from pirl_rl.evaluation.accuracy import Accuracy
from pirl_rl.evaluation.calibration import Calibration
from pirl_rl.evaluation.evaluator import Evaluator, Evidence, Metrics, evaluate, meanings_of, metrics_of
from pirl_rl.evaluation.exact_error import ExactError
from pirl_rl.evaluation.residuals import Residuals
from pirl_rl.evaluation.rollouts import Rollouts
from pirl_rl.evaluation.slices import Slices
from pirl_rl.evaluation.success import Success

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
    "evaluate",
    "meanings_of",
    "metrics_of",
]
