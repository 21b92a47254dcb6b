"""All figures: of evidence, runs, comparisons of runs, sweeps and the tree of an outer loop.

The functions here draw data and return matplotlib figures; `save_figures` writes them.
"""

from pirl_rl.figures.accuracy import draw_accuracy
from pirl_rl.figures.evidence import draw, draw_all
from pirl_rl.figures.files import DPI, FIGURES, save_figures
from pirl_rl.figures.reliability import draw_calibration
from pirl_rl.figures.rollouts import draw_rollouts
from pirl_rl.figures.run import draw_run
from pirl_rl.figures.slices import draw_slices
from pirl_rl.figures.suite import draw_suite

__all__ = [
    "DPI",
    "FIGURES",
    "draw",
    "draw_accuracy",
    "draw_all",
    "draw_calibration",
    "draw_rollouts",
    "draw_run",
    "draw_slices",
    "draw_suite",
    "save_figures",
]
