"""Filters that protect any nominal controller by a learned solution.

filtered = pirl_rl.ReachAvoidFilter(run, nominal, p=0.9)
u = filtered(tau, x)
"""

from pirl_rl.filters.filter import MODES, ReachAvoidFilter
from pirl_rl.filters.least_restrictive import LeastRestrictive
from pirl_rl.filters.smallest_change import SmallestChange, nearest_action
from pirl_rl.filters.step_ahead import values_ahead
from pirl_rl.filters.submartingale import Submartingale

__all__ = [
    "MODES",
    "LeastRestrictive",
    "ReachAvoidFilter",
    "SmallestChange",
    "Submartingale",
    "nearest_action",
    "values_ahead",
]
