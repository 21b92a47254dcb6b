"""Problems shipped with the package, one file each."""

from pirl_rl.problems.drift import VehicleDrift
from pirl_rl.problems.drift3 import VehicleDrift3
from pirl_rl.problems.reach1d import Reach1D
from pirl_rl.problems.safety1d import Safety1D

__all__ = ["Reach1D", "Safety1D", "VehicleDrift", "VehicleDrift3"]
