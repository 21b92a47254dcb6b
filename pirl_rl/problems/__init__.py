"""Problems shipped with the package, one file each."""

from pirl_rl.problems.reach1d import Reach1D
from pirl_rl.problems.safety1d import Safety1D

__all__ = ["Reach1D", "Safety1D"]
