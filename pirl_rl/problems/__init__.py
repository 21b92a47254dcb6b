"""The problems that come with the package, one file each, or one folder if a problem has more than its physics.

They are extensions like those of a user: a configuration names them, and no general module of the package imports them.
"""

from pirl_rl.problems.drift.problem import VehicleDrift
from pirl_rl.problems.drift.three_state import VehicleDrift3
from pirl_rl.problems.reach1d import Reach1D
from pirl_rl.problems.safety1d import Safety1D

__all__ = ["Reach1D", "Safety1D", "VehicleDrift", "VehicleDrift3"]
